"""The files of a simulated field: what is written, and under which name.

Catalogues `members.ecsv`, `subhaloes.ecsv` (the truth of every one), `sources.ecsv`, `images.ecsv`,
`galaxies.ecsv`; maps `kappa_true.fits`, `truth.fits`, `shear.fits`; the true lens `lens_true.toml`;
configurations `strong.toml` and `weak.toml`, so that `jaxlens strong` and `jaxlens weak` read the directory,
and `config.toml`, which makes it again; `summary.json` and figures.
"""

import re
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from jaxlens import config_simulate, critical, io, plotting, workflow_simulate
from jaxlens._config import dumps
from jaxlens.config_simulate import MAP_REDSHIFT
from jaxlens.grid import Grid, resample
from jaxlens.simulate import Mock, expected_sources, mean_counts, padded

OPTIONAL = re.compile(r"strong\.toml|(shear|truth)_\d+\.fits")
"""Names of the files that some fields have and others do not."""

FIGURE_PIXELS = 512
"""Of the convergence in the figure."""


def summary(mock: Mock, said: config_simulate.Simulate) -> dict[str, Any]:
    """The content of `summary.json`."""
    strong, plane, settings = mock.strong, mock.cluster.plane, mock.strong.settings
    ratio = float(plane.dls_ds(MAP_REDSHIFT))
    catalogue, images = strong.catalogue, strong.images
    z = strong.sources.z[catalogue.source]
    expected = expected_sources(settings.sources, plane).expected(settings.sources.box_arcsec**2)
    members = workflow_simulate.member_columns(strong)
    return {
        "name": said.name,
        "seed": strong.seed,
        "n_systems": catalogue.n_systems,
        "n_images": catalogue.n_images,
        "z_systems": {"min": _edge(z, np.min), "median": _edge(z, np.median), "max": _edge(z, np.max)},
        "n_sources": len(strong.sources),
        "n_sources_expected": expected,
        "n_images_all": len(images),
        "n_sources_doubtful": len(images.doubtful),
        "caustic_margin_arcsec": strong.caustic.arcsec,
        "caustic_cut_by_window": strong.caustic.cut,
        "kappa_mean_z2": ratio * float(mock.field.fine.mean()),
        "shear_mode": settings.shear.mode,
        "n_galaxies": len(mock.galaxies),
        "n_galaxies_expected": float(mean_counts(settings.shear, plane).sum()),
        "bins": [
            {
                "z_s": one.z_s,
                "dls_ds": float(plane.dls_ds(one.z_s)),
                "kappa_mean": float(one.kappa.mean()),
                "n_masked": int((np.abs(np.asarray(one.g)) > settings.shear.g_max).sum()),
                "n_empty": int((np.asarray(one.shear.n_gal) == 0).sum()),
                "n_galaxies": int(one.shear.n_gal.sum()),
            }
            for one in mock.bins
        ],
        "n_subhaloes": len(mock.cluster.subhaloes["mass_msun"]),
        "n_members": len(members["bcg"]),
        "clumps": [
            {
                "x_arcsec": one.x_arcsec,
                "y_arcsec": one.y_arcsec,
                "mass_vir_msun": one.mass_msun,
                "smooth_mass_msun": one.smooth_mass_msun,
                "concentration": one.concentration,
                "axis_ratios": list(one.axis_ratios),
                "e": 1.0 - one.q,
                "pa_deg": float(np.rad2deg(one.pa_rad) % 180.0),
                "subhalo_fraction": one.subhalo_mass_msun / one.mass_msun,
                "bcg_mass_msun": one.bcg_mass_msun,
                "bcg_r_s_arcsec": one.bcg_r_s_arcsec,
            }
            for one in mock.cluster.clumps
        ],
        "kpc_per_arcsec": float(plane.kpc_per_arcsec),
        "version": metadata.version("jaxlens-cluster"),
    }


def _edge(values: np.ndarray, of: Any) -> float | None:
    return float(of(values)) if len(values) else None


def figures(mock: Mock, said: config_simulate.Simulate) -> dict[str, Any]:
    """The figures (`matplotlib.figure.Figure`) by file stem."""
    strong, plane, settings = mock.strong, mock.cluster.plane, mock.strong.settings
    kpc = float(plane.kpc_per_arcsec)
    ratio = float(plane.dls_ds(MAP_REDSHIFT))
    catalogue, images, sources = strong.catalogue, strong.images, strong.sources
    columns = workflow_simulate.member_columns(strong)
    whole = settings.shear.map_grid
    grid = Grid.square(2.0 * settings.images.half_width_arcsec, 0.5)
    found = critical.curves(padded(mock.cluster.lens), grid, ratio)
    side = min(FIGURE_PIXELS, whole.shape[0])
    kappa, shown = resample(mock.field.fine, whole, (side, side))
    bin_one = mock.bins[0]
    return {
        "kappa": plotting.simulated_cluster(
            ratio * kappa,
            shown,
            members=np.stack([columns["x_arcsec"], columns["y_arcsec"]], axis=1),
            luminosity=columns["luminosity"],
            bcg=columns["bcg"] == 1,
            tangential=found.tangential,
            radial=found.radial,
            theta=catalogue.theta,
            systems=catalogue.system,
            z_s=MAP_REDSHIFT,
            kpc_per_arcsec=kpc,
            title=said.name,
        ),
        "sources": plotting.source_population(
            sources.z,
            sources.mag,
            expected=expected_sources(settings.sources, plane),
            area=settings.sources.box_arcsec**2,
            systems=catalogue.source,
            image_radius=np.hypot(*images.theta.T) * kpc,
            image_mag=images.mag,
            detected=images.mag < images.limit,
            limit=(settings.images.m_tele, settings.images.m_loss, settings.images.scale_kpc),
            title=said.name,
        ),
        "weak_data": plotting.weak_data(
            bin_one.shear.n_gal,
            np.abs(np.asarray(bin_one.g)) <= settings.shear.g_max,
            bin_one.shear.g,
            settings.shear.grid,
            kpc_per_arcsec=kpc,
            title=said.name if len(mock.bins) == 1 else f"{said.name}, $z_s = {bin_one.z_s:g}$",
        ),
    }


def write(mock: Mock, said: config_simulate.Simulate, out: str | Path) -> dict[str, Any]:
    """Write every file of the field to the directory `out`, all of them or none; returns the summary.

    The same seed and configuration give the same bytes in every file of data. Files of an earlier field there
    that this one does not have (`OPTIONAL`) are removed, since the commands would read them beside the new
    ones; `removed` in the returned summary names them. Other files stay.
    """
    earlier = (Path(out) / "lens_true.toml").is_file()
    content = summary(mock, said)
    drawn = figures(mock, said)
    strong, plane, settings = mock.strong, mock.cluster.plane, mock.strong.settings
    meta = {"cluster": said.name, "seed": strong.seed, "version": content["version"]}
    ratio = float(plane.dls_ds(MAP_REDSHIFT))
    base = {"ZLENS": float(plane.z_l), "SEED": strong.seed, "BUNIT": ""}
    tables = {
        "members": workflow_simulate.member_columns(strong),
        "subhaloes": mock.cluster.subhaloes,
        "sources": workflow_simulate.source_columns(strong),
        "images": workflow_simulate.image_columns(strong),
        "galaxies": workflow_simulate.galaxy_columns(mock),
    }
    texts = {
        "config.toml": config_simulate.text(said),
        "weak.toml": dumps(workflow_simulate.weak_configuration(mock, said)),
    }
    if strong.catalogue.n_systems:
        texts["strong.toml"] = dumps(workflow_simulate.strong_configuration(strong, said))
    with io.staging(out) as stage:
        io.write_json(stage / "summary.json", content)
        for name, one in texts.items():
            (stage / name).write_text(one, encoding="utf-8")
        for name, columns in tables.items():
            io.write_table(stage / f"{name}.ecsv", columns, meta=meta, descriptions=_DESCRIPTIONS)
        io.write_lens(
            stage / "lens_true.toml",
            mock.cluster.lens,
            plane,
            comment=f"{said.name}, seed {strong.seed}, jaxlens {content['version']}",
        )
        io.write_map(
            stage / "kappa_true.fits",
            ratio * np.asarray(mock.field.fine),
            settings.shear.map_grid,
            header={**base, "ZSOURCE": MAP_REDSHIFT, "DLSDS": ratio},
            dtype="float32",
        )
        _write_bins(stage, mock, said, base)
        for name, figure in drawn.items():
            plotting.save(figure, stage / name)
    removed = [name for name in stage.untouched if earlier and OPTIONAL.fullmatch(name)]
    for name in removed:
        (Path(out) / name).unlink(missing_ok=True)
    return {**content, "removed": removed}


def _write_bins(stage: io.Staging, mock: Mock, said: config_simulate.Simulate, base: dict[str, Any]) -> None:
    """`shear.fits` and `truth.fits` of the first bin; of further ones `shear_2.fits`, `truth_2.fits`, ..."""
    plane, shear = mock.cluster.plane, mock.strong.settings.shear
    for number, one in enumerate(mock.bins, start=1):
        ending = "" if number == 1 else f"_{number}"
        header = {
            **base,
            "ZSOURCE": one.z_s,
            "DLSDS": float(plane.dls_ds(one.z_s)),
            "SHEARMOD": (shear.mode, "how the true shear was made"),
        }
        smooth = (said.weak.sigma_pixels * shear.grid.pixel, "[arcsec] to smooth with; not yet smoothed")
        io.write_shear_map(
            stage / f"shear{ending}.fits",
            one.shear.g,
            one.shear.weight,
            one.shear.n_gal,
            shear.grid,
            header={**header, "SMOOTHBY": smooth},
        )
        g = np.asarray(one.g)
        layers = {
            "KAPPA": one.kappa,
            "G1": np.real(g),
            "G2": np.imag(g),
            "MASK": (np.abs(g) <= shear.g_max).astype(int),
        }
        io.write_cube(stage / f"truth{ending}.fits", layers, shear.grid, header=header)


_DESCRIPTIONS = {
    "luminosity": "B band, relative to the brightest satellite",
    "luminosity_b_lsun": "B band, solar luminosities",
    "luminosity_b": "B band, solar luminosities",
    "bcg": "1 for central galaxies",
    "mag_uv": "absolute, AB",
    "mag": "apparent, AB",
    "mag_limit": "limiting magnitude at the position of the image",
    "mu": "signed magnification",
    "n_images": "all images of the source",
    "n_detected": "those brighter than the limit",
    "system": "name of the system",
    "x_true_arcsec": "without error of position",
    "y_true_arcsec": "without error of position",
    "e1": "observed ellipticity (a - b)/(a + b) cos 2 phi, phi from West through North",
    "e2": "observed ellipticity (a - b)/(a + b) sin 2 phi",
    "use": "0 in masked pixels",
    "z_kpc": "along the line of sight, from the centre of the clump",
    "clump": "index of the halo",
}


def verdict(content: dict[str, Any]) -> str:
    """What the summary says, in a few lines."""
    margin = content["caustic_margin_arcsec"]
    one = content["bins"][0]
    lines = [
        f"{content['n_sources']} sources ({content['n_sources_expected']:.1f} expected), "
        f"{content['n_systems']} systems with {content['n_images']} detected images",
        f"mean kappa of the field {content['kappa_mean_z2']:.4f} for z_s = {MAP_REDSHIFT:g}; "
        f"{content['n_subhaloes']} subhaloes",
        f"{content['n_galaxies']} galaxies ({content['n_galaxies_expected']:.1f} expected), shear "
        f"{content['shear_mode']}, {one['n_masked']} pixels masked",
    ]
    if margin < 0.0:
        lines.append(
            f"the main caustic leaves the box of the sources by {-margin:.1f} arcsec: systems are missed; "
            "raise box_arcsec under [sources]"
        )
    elif content["caustic_cut_by_window"]:
        lines.append(
            "the window cuts the main critical curve: images are missed, and whether its caustic leaves the "
            "box is not known; raise half_width_arcsec under [images]"
        )
    elif not np.isfinite(margin):
        lines.append(
            "no critical curve closes in the window: nothing is multiply imaged by the whole cluster"
        )
    if content["n_sources_doubtful"]:
        lines.append(
            f"{content['n_sources_doubtful']} sources may lack an image: the parities of those found do not "
            "add up; lower pixel_arcsec under [images]"
        )
    if removed := content.get("removed"):
        lines.append(f"removed from an earlier result: {', '.join(removed)}")
    if not content["n_systems"]:
        lines.append("no system has enough detected images: there is no strong.toml")
    return "\n".join(lines)
