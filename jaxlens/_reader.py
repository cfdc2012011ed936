"""From the tables of a `strong.toml` to ingredients, members, boxes, priors and starts."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxlens import config, io
from jaxlens._types import Array
from jaxlens.config import ConfigError, Free
from jaxlens.cosmology import LensPlane
from jaxlens.strong import (
    FORMS,
    Angle,
    Bounds,
    Box,
    Disc,
    Ingredient,
    LogNormalPrior,
    MemberSet,
    NormalPrior,
    RedshiftPrior,
)


class Reader:
    """Collects boxes, priors and starts while the components are read."""

    def __init__(self, source: str, plane: LensPlane):
        self.source, self.plane = source, plane
        self.kpc_per_arcsec = float(plane.kpc_per_arcsec)
        self.h = float(plane.cosmology.h)
        self.bounds: Bounds = {}
        self.priors: list[NormalPrior | LogNormalPrior | RedshiftPrior] = []
        self.start: dict[str, Array] = {}

    def _standard(self, key: str) -> tuple[str, float]:
        """The name in the package's unit, and the factor to it: kpc to arcsec, Msun/h to Msun."""
        if key.endswith("_kpc"):
            return key.removesuffix("_kpc") + "_arcsec", 1.0 / self.kpc_per_arcsec
        if key.endswith("_msun_h"):
            return key.removesuffix("_h"), 1.0 / self.h
        return key, 1.0

    def number(self, owner: str, key: str, value: Any, fixed: dict[str, Array]) -> None:
        """Put one number among the fixed ones, or make it free."""
        parsed = (
            value if isinstance(value, Free) else config.free_number(value, f"{owner}.{key}", self.source)
        )
        name, factor = self._standard(key)
        if not isinstance(parsed, Free):
            fixed[name] = jnp.asarray(factor * parsed)
            return
        full = f"{owner}.{name}"
        self.bounds[full] = Box(factor * parsed.min, factor * parsed.max, log=parsed.log)
        if parsed.start is not None:
            self.start[full] = jnp.asarray(factor * parsed.start)
        if parsed.mean is not None and parsed.sigma is not None:
            self.priors.append(
                NormalPrior(full, jnp.asarray(factor * parsed.mean), jnp.asarray(factor * parsed.sigma))
            )
        if parsed.median is not None and parsed.sigma_ln is not None:
            self.priors.append(LogNormalPrior(full, factor * parsed.median, parsed.sigma_ln))

    def redshift(self, one: config.Redshift, said: config.Images, systems: tuple[str, ...]) -> None:
        """Limits, prior and start of a free redshift, whose box for all systems is there already."""
        where, name = f"{self.source}: redshift of system {one.system}", f"dls_ds.{one.system}"
        if one.system not in systems:
            raise ConfigError(f"{where}: there is no such system; the catalogue has {', '.join(systems)}.")
        if name not in self.bounds:
            raise ConfigError(
                f"{where}: the catalogue gives it; leave it empty there to free it, or leave this out."
            )
        z_l = float(self.plane.z_l)
        low = one.min if one.min is not None else said.z_min if said.z_min is not None else z_l + 0.1
        high = said.z_max if one.max is None else one.max
        if not z_l < low < high:
            raise ConfigError(
                f"{where}: from {low:g} to {high:g} is no range behind the lens (z_l = {z_l:g}); "
                "correct min and max."
            )
        for key, value in (("mean", one.mean), ("start", one.start)):
            if value is not None and not low <= value <= high:
                raise ConfigError(f"{where}: {key} = {value:g} is outside {low:g} to {high:g}; correct one.")
        self.bounds[name] = Box(self.plane.dls_ds(low), self.plane.dls_ds(high), weak=False)
        if one.start is not None:
            self.start[name] = self.plane.dls_ds(one.start)
        if one.mean is not None and one.sigma is not None:
            self.priors.append(RedshiftPrior(one.system, self.plane, one.mean, one.sigma))

    def ingredient(self, one: config.Component) -> Ingredient:
        where = f"{self.source}: component {one.name}"
        if one.profile not in FORMS:
            raise ConfigError(
                f"{where}: profile is {one.profile!r}; choose one of {', '.join(sorted(FORMS))}."
            )
        form = FORMS[one.profile]
        allowed = [*form.numbers, *(["x_arcsec", "y_arcsec"] if form.centred else [])]
        if form.shape:
            allowed.append(form.shape)
        fixed: dict[str, Array] = {}
        said: dict[str, str] = {}
        for key, value in one.numbers.items():
            first = said.setdefault(self._standard(key)[0], key)
            if first != key:
                raise ConfigError(f"{where}: {key} and {first} are the same number; leave out one of them.")
            if self._standard(key)[0] not in allowed:
                raise ConfigError(
                    f"{where}: {key} is not a number of the profile {one.profile}; "
                    f"it takes {', '.join(allowed)} (lengths also in _kpc, masses also in _msun_h)."
                )
            self.number(one.name, key, value, fixed)
        self._orientation(one, form.shape, fixed, where)
        given = {*fixed, *(key.partition(".")[2] for key in self.bounds if key.startswith(f"{one.name}."))}
        missing = [name for name in form.numbers if name not in given]
        if missing:
            raise ConfigError(f"{where}: {', '.join(missing)} missing; give each a number or a box.")
        return Ingredient(one.name, one.profile, fixed)

    def _orientation(
        self, one: config.Component, shape: str | None, fixed: dict[str, Array], where: str
    ) -> None:
        has_shape = shape is not None and (shape in fixed or f"{one.name}.{shape}" in self.bounds)
        if one.shape is not None:
            if shape is None or has_shape or one.pa_deg is not None:
                raise ConfigError(
                    f"{where}: shape = {{ max = ... }} frees the elongation and the angle together; "
                    f"leave out {shape or 'it (this profile is round)'} and pa_deg."
                )
            self.bounds[f"{one.name}.shape"] = Disc(one.shape.max)
            if one.shape.start is not None:
                e, angle = one.shape.start[0], 2.0 * np.deg2rad(one.shape.start[1])
                self.start[f"{one.name}.shape"] = jnp.array([e * np.cos(angle), e * np.sin(angle)])
        elif one.pa_deg == "free":
            if shape is None or (f"{one.name}.{shape}" not in self.bounds and shape not in fixed):
                raise ConfigError(
                    f"{where}: pa_deg is free but the component has no elongation; "
                    f"{f'give {shape}' if shape else 'leave out pa_deg, the profile is round'}."
                )
            self.bounds[f"{one.name}.pa"] = Angle()
        elif one.pa_deg is not None:
            fixed["pa"] = jnp.asarray(np.deg2rad(one.pa_deg))
        elif has_shape:
            raise ConfigError(f'{where}: {shape} is given without pa_deg; give the angle, or "free".')

    def members(
        self,
        said: config.Members,
        settings: config.Strong,
        folder: Path,
        images: np.ndarray,
        name: str = "members",
    ) -> MemberSet:
        table = io.read_members(folder / said.file, reference=settings.reference, mag_ref=said.mag_ref)
        keep = ~np.asarray(table.bcg)
        if said.within_images_arcsec is not None:
            margin = said.within_images_arcsec
            inside = (table.theta >= images.min(axis=0) - margin) & (
                table.theta <= images.max(axis=0) + margin
            )
            keep &= inside.all(axis=1)
        if not keep.any():
            raise ConfigError(f"{folder / said.file}: no member is left inside the rectangle of the images.")
        fixed: dict[str, Array] = {}
        numbers = (
            "sigma_ref_km_s",
            "r_cut_ref_arcsec",
            "r_cut_ref_kpc",
            "r_core_ref_arcsec",
            "r_core_ref_kpc",
        )
        for key in numbers:
            value = getattr(said, key)
            if value is not None:
                self.number(name, key, value, fixed)
        q = 1.0 - np.asarray(table.e)[keep] if said.shape == "light" else np.ones(int(keep.sum()))
        e = (1.0 - q**2) / (1.0 + q**2) if said.convention == "dpie_lenstool" else 1.0 - q
        return MemberSet(
            theta=jnp.asarray(np.asarray(table.theta)[keep]),
            luminosity=jnp.asarray(np.asarray(table.luminosity)[keep]),
            e=jnp.asarray(e),
            pa=jnp.asarray(np.asarray(table.pa)[keep]),
            fixed=fixed,
            exponents=(said.sigma_exponent, said.cut_exponent, said.core_exponent),
            convention=said.convention,
            name=name,
        )
