"""A cluster model from named numbers: haloes, galaxies and members, each number fixed or free.

Numbers carry their component and unit in the name, e.g. `O1.r_core_arcsec`. Ellipticity and position
angle of one component may be free together as the two components `O1.shape` of a `Disc`.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from jaxlens import profiles, scaling
from jaxlens._types import Array, Float
from jaxlens.cosmology import LensPlane, redshift_of_dls_ds
from jaxlens.lens import Component, Lens
from jaxlens.profiles import dpie, hernquist, nfw, point
from jaxlens.strong._bounds import Bounds, Box, Params
from jaxlens.strong._chi2 import ImageCatalogue, Prediction

# Shift (dimensionless ellipticity) that gives e = 0 a direction: the field is smooth there in
# (e cos 2pa, e sin 2pa) although e and pa are not.
_TINY_E = 1e-6


class Form(eqx.Module):
    """How the numbers of one kind of component become a profile.

    Attributes:
        numbers: names with unit, in the order of `make`.
        make: `(plane, shape, *numbers) -> params`, all `(n,)`.
        shape: name of the elongation: `e`, `ellipticity`, `gamma`, or None for round ones.
        centred: whether the component has a position.
    """

    numbers: tuple[str, ...] = eqx.field(static=True)
    make: Callable[..., Any] = eqx.field(static=True)
    shape: str | None = eqx.field(static=True, default="e")
    centred: bool = eqx.field(static=True, default=True)


def _nfw(definition: str | float) -> Callable[..., Any]:
    return lambda plane, e, mass, c: nfw.from_mass(mass, c, plane, e=e, definition=definition)


FORMS: dict[str, Form] = {
    "nfw": Form(("mass_vir_msun", "concentration"), _nfw("bryan_norman")),
    "nfw_200c": Form(("mass_200c_msun", "concentration"), _nfw(200.0)),
    "nfw_nakamura_suto": Form(("mass_vir_msun", "concentration"), _nfw("nakamura_suto")),
    "hernquist": Form(
        ("mass_msun", "r_s_arcsec"), lambda plane, e, mass, r_s: hernquist.from_mass(mass, r_s, plane, e=e)
    ),
    "dpie": Form(
        ("sigma_v_km_s", "r_core_arcsec", "r_cut_arcsec"),
        lambda plane, e, sigma, core, cut: dpie.from_sigma_v(sigma, core, cut, e=e),
    ),
    "dpie_lenstool": Form(
        ("sigma_lt_km_s", "r_core_arcsec", "r_cut_arcsec"),
        lambda plane, e, sigma, core, cut: dpie.from_lenstool(sigma, core, cut, ellipticity=e),
        shape="ellipticity",
    ),
    "sie": Form(
        ("sigma_v_km_s", "r_core_arcsec"),
        lambda plane, e, sigma, core: profiles.SIE(b=dpie.strength(sigma), e=e, r_core=core),
    ),
    "point": Form(
        ("mass_msun",),
        lambda plane, e, mass: profiles.PointMass(theta_e=point.einstein_radius(mass, plane)),
        shape=None,
    ),
    "shear": Form((), lambda plane, gamma: profiles.Shear(gamma=gamma), shape="gamma", centred=False),
    "sheet": Form(("kappa",), lambda plane, e, kappa: profiles.Sheet(kappa=kappa), shape=None, centred=False),
}
"""The kinds of component that a model knows, by the name that configuration files use."""


def register_form(name: str, form: Form) -> None:
    """Add a kind of component under a name of its own.

    Raises:
        ValueError: if the name is taken.
    """
    if name in FORMS:
        raise ValueError(f"The kind of component {name!r} exists already; register it under another name.")
    FORMS[name] = form


class Ingredient(eqx.Module):
    """One component of a model.

    Attributes:
        name: name of the component; prefixes its numbers.
        form: key of `FORMS`.
        fixed: numbers that are not free, by their name without the component's; scalars. Position
            angles are in rad under the name `pa`.
    """

    name: str = eqx.field(static=True)
    form: str = eqx.field(static=True)
    fixed: dict[str, Array]


class MemberSet(eqx.Module):
    """Cluster members on scaling relations; see `jaxlens.scaling.members`.

    Attributes:
        theta: positions, `(n, 2)`, arcsec.
        luminosity: L/L_ref, `(n,)`.
        e: ellipticity of the mass in the convention's definition, `(n,)`.
        pa: position angles, `(n,)`, rad.
        fixed: those of `sigma_ref_km_s`, `r_cut_ref_arcsec`, `r_core_ref_arcsec` that are not free.
        exponents: of sigma, r_cut and r_core with luminosity.
        convention: `"dpie"` or `"dpie_lenstool"`.
        name: prefixes the free numbers, and names the component of the lens.
    """

    theta: Float[Array, "n 2"]
    luminosity: Float[Array, " n"]
    e: Float[Array, " n"]
    pa: Float[Array, " n"]
    fixed: dict[str, Array]
    exponents: tuple[float, float, float] = eqx.field(static=True, default=(0.25, 0.5, 0.5))
    convention: str = eqx.field(static=True, default="dpie")
    name: str = eqx.field(static=True, default="members")


def _elongation(pair: Array) -> tuple[Array, Array]:
    """e and pa of (e cos 2pa, e sin 2pa), `(2,)`, with the right limit of the gradient at e = 0."""
    safe = pair + jnp.where(pair @ pair < _TINY_E**2, jnp.array([_TINY_E, 0.0], pair.dtype), 0.0)
    return jnp.sqrt(safe @ safe), 0.5 * jnp.arctan2(safe[1], safe[0])


class ClusterModel(eqx.Module):
    """A ready-made `build` of `strong.Problem`: a pure function from free numbers to a lens.

    Free numbers are named `<component>.<number>`, `<component>.shape` (e and angle together),
    `<component>.pa`, `members.<number>` (or the name of a group) and `dls_ds.<system>` (a free source
    redshift; the fit moves in the distance ratio, in which it is better behaved than in z).

    Attributes:
        plane: the lens plane.
        ingredients: haloes, galaxies, shear.
        members: members on scaling relations, or None.
        dls_ds: distance ratio of every system, `(s,)`; those of free redshifts are overridden.
        systems: names of the systems.
        groups: further sets on scaling relations of their own, each with its own name.
    """

    plane: LensPlane
    ingredients: tuple[Ingredient, ...]
    members: MemberSet | None
    dls_ds: Float[Array, " s"]
    systems: tuple[str, ...] = eqx.field(static=True, default=())
    groups: tuple[MemberSet, ...] = ()

    def _numbers(self, one: Ingredient, params: Params) -> dict[str, Array]:
        prefix = f"{one.name}."
        free = {key.removeprefix(prefix): value for key, value in params.items() if key.startswith(prefix)}
        numbers = {**one.fixed, **free}
        shape = FORMS[one.form].shape
        if "shape" in free and shape is not None:
            numbers[shape], numbers["pa"] = _elongation(free["shape"])
        return numbers

    def lens(self, params: Params) -> Lens:
        """The lens at the free numbers `params`."""
        grouped: dict[str, list[dict[str, Array]]] = {}
        for one in self.ingredients:
            grouped.setdefault(one.form, []).append(self._numbers(one, params))
        components = {name: _component(name, rows, self.plane) for name, rows in grouped.items()}
        for one in (*(() if self.members is None else (self.members,)), *self.groups):
            components[one.name] = _members(one, params)
        return Lens(components)

    @property
    def labels(self) -> dict[str, tuple[str, ...]]:
        """Names of the ingredients by the component of the lens that holds them, in its order."""
        out: dict[str, tuple[str, ...]] = {}
        for one in self.ingredients:
            out[one.form] = (*out.get(one.form, ()), one.name)
        return out

    def __call__(self, params: Params) -> Prediction:
        """Lens and distance ratios at the free numbers `params`."""
        ratios = self.dls_ds
        for index, system in enumerate(self.systems):
            name = f"dls_ds.{system}"
            if name in params:
                ratios = ratios.at[index].set(params[name])
        return Prediction(self.lens(params), ratios)


def _component(form_name: str, rows: list[dict[str, Array]], plane: LensPlane) -> Component:
    form = FORMS[form_name]

    def column(name: str, default: float | None = None) -> Array:
        missing = [row for row in rows if name not in row]
        if missing and default is None:
            raise ValueError(f"A `{form_name}` component needs the number `{name}`, fixed or free.")
        return jnp.stack([jnp.asarray(row.get(name, default), jnp.result_type(float)) for row in rows])

    shape = column(form.shape, 0.0) if form.shape else jnp.zeros(len(rows))
    params = form.make(plane, shape, *(column(name) for name in form.numbers))
    centre = jnp.stack([column("x_arcsec", 0.0), column("y_arcsec", 0.0)], axis=1)
    return Component(params, centre, column("pa", 0.0))


def _members(one: MemberSet, params: Params) -> Component:
    prefix = f"{one.name}."
    free = {key.removeprefix(prefix): value for key, value in params.items() if key.startswith(prefix)}
    numbers = {"r_core_ref_arcsec": jnp.zeros(()), **one.fixed, **free}
    return scaling.members(
        one.theta,
        one.luminosity,
        sigma_ref=numbers["sigma_ref_km_s"],
        r_cut_ref=numbers["r_cut_ref_arcsec"],
        r_core_ref=numbers["r_core_ref_arcsec"],
        e=one.e,
        pa=one.pa,
        sigma_exponent=one.exponents[0],
        cut_exponent=one.exponents[1],
        core_exponent=one.exponents[2],
        convention=one.convention,
    )


def free_redshifts(
    images: ImageCatalogue, plane: LensPlane, z_max: float = 10.0, z_min: float | None = None
) -> Bounds:
    """Boxes for the systems without a redshift: uniform in D_LS/D_S between `z_min` (z_l + 0.1) and `z_max`.

    The weak prior of a fit never applies to them: it pulls well-measured redshifts (measured on
    SMACS J0723: system 16 from 1.10 to 1.67).
    """
    lo, hi = plane.dls_ds(plane.z_l + 0.1 if z_min is None else z_min), plane.dls_ds(z_max)
    return {
        f"dls_ds.{name}": Box(lo, hi, weak=False)
        for name, z in zip(images.systems, images.z_s, strict=True)
        if bool(jnp.isnan(z))
    }


def reported(model: ClusterModel, params: Params) -> dict[str, Array]:
    """The numbers a reader wants, all scalars: e and pa_deg of shapes, z of distance ratios.

    Position angles are in degrees modulo 180, in [-90, 90). Differentiable except at that seam.
    """
    forms = {one.name: FORMS[one.form] for one in model.ingredients}
    out: dict[str, Array] = {}
    for key, value in params.items():
        name, _, number = key.partition(".")
        if number == "shape":
            e, pa = _elongation(value)
            out[f"{name}.{forms[name].shape}"] = e
            out[f"{name}.pa_deg"] = _degrees(pa)
        elif number == "pa":
            out[f"{name}.pa_deg"] = _degrees(value)
        elif name == "dls_ds":
            out[f"z.{number}"] = redshift_of_dls_ds(model.plane, value)
        else:
            out[key] = value
    return out


def _degrees(pa: Array) -> Array:
    turn = jnp.rad2deg(pa)
    return turn - 180.0 * jnp.floor(turn / 180.0 + 0.5)
