"""What a weak-lensing summary says, in words."""

from typing import Any

_FRAMES = {
    "west": "g1 > 0 along West, g2 > 0 from West towards North",
    "east": "g1 > 0 along East, g2 > 0 from East towards North",
    "north": "g1 > 0 along North, angles from North through East",
}


def _calibration(nfw: dict[str, Any]) -> str:
    found, prior = nfw["calibration"], nfw["calibration_prior"]
    if prior["error"] == 0.0:
        return f"for a shape calibration of {prior['value']:g}, held fixed"
    return (
        f"shape calibration {found['value']:.2f} +- {found['error']:.2f} "
        f"(prior {prior['value']:g} +- {prior['error']:g})"
    )


def verdict(content: dict[str, Any]) -> str:
    """What the summary says, in a few lines."""
    peak, highest, e, b = (content[name] for name in ("peak", "peak_snr", "e_mode", "b_mode"))
    place = f"peak of kappa = {peak['kappa']:.2f} +- {peak['kappa_error']:.2f} at x = {peak['x_arcsec']:.1f}"
    if peak["x_error_arcsec"] is not None:
        place += f" +- {peak['x_error_arcsec']:.1f}"
    place += f", y = {peak['y_arcsec']:.1f}"
    if peak["y_error_arcsec"] is not None:
        place += f" +- {peak['y_error_arcsec']:.1f}"
    lines = [
        f"{place} arcsec; largest S/N {highest['value']:.1f}",
        "kappa holds up to a mass sheet (its mean over the padded map is 0), without any shape calibration",
        f"frame of the input shear: {_FRAMES[content['shear_axis']]}; no null test shows a wrong one",
        f"E mode: chi2 per pixel {e['chi2']:.2f}, {e['significance']:.1f} sigma "
        f"({content['null_maps']} null maps of turned "
        + ("galaxies)" if content["from_catalogue"] else "pixels, less the shear that the map explains)"),
        f"B mode: chi2 per pixel {b['chi2']:.2f}, {b['significance']:.1f} sigma",
    ]
    if (rest := content["b_mode_beyond_e"]) is not None:
        lines[-1] += f"; beyond what the E mode explains {rest['chi2']:.2f}, {rest['significance']:.1f} sigma"
    if (nfw := content["nfw"]) is not None:
        mass, c = nfw["mass_msun"], nfw["concentration"]
        lines += [
            f"tangential shear {content['tangential_snr']:.1f} sigma, "
            f"cross shear {content['cross_snr']:.1f} sigma",
            f"NFW: M = ({mass['value'] / 1e14:.1f} +- {mass['error'] / 1e14:.1f})e14 Msun, "
            f"c = {c['value']:.1f} +- {c['error']:.1f}, {_calibration(nfw)}"
            + ("" if nfw["converged"] else "; the fit has not converged"),
        ]
    if (drawn := content["photometric_redshifts"]) is not None:
        lines.append(
            f"photometric redshifts ({drawn['draws']} draws): +- {drawn['kappa_error_at_peak']:.1e} of "
            f"kappa at the peak, +- {drawn['log10_mass_error']:.3f} of log10 M"
        )
    if content["spectral_radius"] >= 1.0:
        lines.append(
            f"the iteration diverges (spectral radius {content['spectral_radius']:.2f}): the map means "
            "nothing; smooth more or mask pixels of large shear"
        )
    elif not content["converged"]:
        lines.append(
            f"not converged: the last iteration changed kappa by {content['last_change']:.1e}; "
            "give more --iterations"
        )
    return "\n".join(lines)
