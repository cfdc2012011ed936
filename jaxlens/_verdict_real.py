"""What `summary.json` of a real cluster says, in a few lines."""

from typing import Any


def _needed(density: dict[str, Any]) -> str:
    """How many galaxies would show a transition, in words."""
    at, found = density["arcmin2"], density["share_found"]
    shares = ", ".join(f"{100 * share:.0f} % at {n:.0f}" for n, share in zip(at, found, strict=True))
    if density["needed_arcmin2"] is None:
        said = f"not even {at[-1]:.0f} galaxies per arcmin^2 would show one"
    else:
        said = f"{density['needed_arcmin2']:.0f} galaxies per arcmin^2 would show one"
    inside = 100 * density["share_inside_first_annulus"][-1]
    return (
        f"{said} in 68 % of simulated fields with subhaloes ({shares}; at {at[-1]:.0f} weak lensing is the "
        f"better probe from the first annulus on in {inside:.0f} %)"
    )


def verdict(content: dict[str, Any]) -> str:
    """What the summary says, in a few lines."""
    strong = content["strong"]
    lines = [
        f"{strong['images']} images of {strong['systems']} systems: chi2 {strong['chi2_source']:.2f} (source "
        f"plane), {strong['starts_agreeing'][0]} of {strong['starts_agreeing'][1]} starts agree"
    ]
    if strong["draws_warning"]:
        lines.append(f"note: {strong['draws_warning']}")
    for one in content["samples"].values():
        lam, (low, high) = one["lambda"], one["inner_kpc_h"]
        begin, end = lam["interval"]["together"]
        said = one["calibration"]
        lines.append(
            f"{one['title']} ({one['galaxies']}, {one['density_arcmin2']:.0f} per arcmin^2, calibration "
            f"{said['mean']:g} +- {said['sigma']:g}): lambda {low:g}-{high:g} kpc/h {lam['value']:.3f}, 68 % "
            f"{begin:.3f} to {end:.3f}; a noiseless map of the model has {lam['expected']:.3f}"
        )
        lines.append(
            f"  slope of the shapes against the model {said['slope']:.2f} +- {said['slope_error']:.2f}; chi2 "
            f"of {said['annuli']} annuli about it {said['slope_chi2']:.1f}"
        )
        if lam["published"] is not None:
            lines.append(f"  with the published model instead of ours: {lam['published']:.3f}")
        if (joint := one.get("joint")) is not None:
            lines.append(
                f"  images and map together: lambda {joint['lam']:.3f} +- {joint['lam_error']:.3f}, "
                f"calibration {joint['m']:.3f} +- {joint['m_error']:.3f}, correlation "
                f"{joint['correlation']:+.2f}; chi2 of the map {joint['chi2_map']:.0f} for {joint['n_map']} "
                f"pixels{'' if joint['converged'] else '; not converged'}"
            )
        found = one["transition"]
        span = (
            "" if found["range_kpc_h"] is None else " at {:.0f} to {:.0f} kpc/h".format(*found["range_kpc_h"])
        )
        where = f"{found['r_kpc_h']:.0f} kpc/h" if found["found"] else "not found"
        lines.append(
            f"  transition by excess variance: {where}; {100 * found['share_of_draws']:.0f} % of the draws "
            f"have one{span}"
        )
        if (density := one.get("density")) is not None:
            lines.append(f"  {_needed(density)}")
    return "\n".join(lines)
