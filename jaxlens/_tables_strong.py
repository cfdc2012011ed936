"""The tables of a strong-lensing fit: images, systems, and images that nobody has observed."""

import numpy as np

from jaxlens import analysis_strong
from jaxlens._outcome import Outcome


def image_table(outcome: Outcome) -> dict[str, np.ndarray]:
    """Columns of `images_predicted.ecsv`: observed, predicted, offset, mu, chi^2 of every image."""
    images, main = outcome.images, outcome.main
    observed = np.asarray(images.theta)
    offset = np.where(main.produced[:, None], main.theta - observed, np.nan)
    chi2 = np.sum(offset**2, axis=1) / np.asarray(images.sigma_pos) ** 2
    source = np.asarray(images.source)
    z = redshifts(outcome)
    return {
        "system": np.array(images.systems)[source],
        "image_id": np.array(images.image_ids),
        "z_s": z[source],
        "x_arcsec": observed[:, 0],
        "y_arcsec": observed[:, 1],
        "x_predicted_arcsec": np.where(main.produced, main.theta[:, 0], np.nan),
        "y_predicted_arcsec": np.where(main.produced, main.theta[:, 1], np.nan),
        "dx_arcsec": offset[:, 0],
        "dy_arcsec": offset[:, 1],
        "offset_arcsec": np.hypot(*offset.T),
        "mu": main.mu,
        "chi2": chi2,
        "produced": main.produced,
        **analysis_strong.image_columns(outcome.fit, outcome.analysis),
    }


def redshifts(outcome: Outcome) -> np.ndarray:
    """Redshift of every system `(s,)`, known or fitted."""
    z = np.array(outcome.images.z_s)
    for index, system in enumerate(outcome.images.systems):
        z[index] = outcome.values.get(f"z.{system}", z[index])
    return z


def system_table(outcome: Outcome) -> dict[str, np.ndarray]:
    """Columns of `systems.ecsv`: source position, counts, chi^2 and rms of every system."""
    images, main = outcome.images, outcome.main
    source = np.asarray(images.source)
    columns = image_table(outcome)
    count = np.bincount(source, minlength=images.n_systems)
    produced = np.bincount(source, main.produced, images.n_systems)
    some = produced > 0
    chi2 = np.bincount(source, np.nan_to_num(columns["chi2"]), images.n_systems)
    squares = np.bincount(source, np.nan_to_num(columns["offset_arcsec"]) ** 2, images.n_systems)
    spare = np.bincount(main.spare[:, 0].astype(int), minlength=images.n_systems)
    return {
        "system": np.array(images.systems),
        "z_s": redshifts(outcome),
        "dls_ds": np.asarray(outcome.fit.dls_ds),
        "beta_x_arcsec": main.beta[:, 0],
        "beta_y_arcsec": main.beta[:, 1],
        "n_images": count,
        "n_produced": produced.astype(int),
        "n_spare": spare,
        "chi2": np.where(some, chi2, np.nan),
        "rms_arcsec": np.where(some, np.sqrt(squares / np.maximum(produced, 1)), np.nan),
        **analysis_strong.system_columns(outcome.fit, outcome.analysis),
    }


def spare_table(outcome: Outcome) -> dict[str, np.ndarray]:
    """Columns of `images_spare.ecsv`: predicted images that no observed image belongs to."""
    spare = outcome.main.spare
    return {
        "system": np.array(outcome.images.systems)[spare[:, 0].astype(int)],
        "x_arcsec": spare[:, 1],
        "y_arcsec": spare[:, 2],
        "mu": spare[:, 3],
    }
