"""Critical curves and caustics against closed forms and a published model."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxlens import critical, datasets, lens, profiles
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid

GRID = Grid.square(60.0, 0.5)


def test_isothermal_sphere_has_its_einstein_ring() -> None:
    sphere = lens.Lens(one=lens.Component(profiles.SIE(b=10.0), (1.0, -2.0)))
    found = critical.curves(sphere, GRID, 0.8)
    (ring,) = [one for one in found.items if one.kind == "tangential"]
    assert ring.closed
    assert_allclose(np.hypot(ring.theta[:, 0] - 1.0, ring.theta[:, 1] + 2.0), 8.0, rtol=1e-10)
    # Its caustic is the point behind the centre.
    assert_allclose(ring.beta, np.broadcast_to([1.0, -2.0], ring.beta.shape), atol=1e-9)
    # Chords of at most h = 0.7 arcsec (a diagonal of the grid) cut off h^2/(12 r^2) of the radius.
    assert_allclose(critical.einstein_radius(found), 8.0, rtol=6.4e-4)


def test_cored_isothermal_sphere_has_both_curves() -> None:
    """kappa = b/(2 sqrt(s^2+r^2)): mean kappa = 1 on the tangential, d alpha/dr = 1 on the radial curve."""
    b, s = 10.0, 1.0
    cored = lens.Lens(one=lens.Component(profiles.SIE(b=b, r_core=s)))
    found = critical.curves(cored, GRID, 1.0)
    kinds = {one.kind: np.hypot(*one.theta.T) for one in found.items}
    # alpha = b (sqrt(s^2 + r^2) - s)/r.
    assert_allclose(kinds["tangential"], np.sqrt(b * (b - 2.0 * s)), rtol=1e-9)
    r = kinds["radial"]
    slope = b / np.sqrt(s**2 + r**2) - b * (np.sqrt(s**2 + r**2) - s) / r**2
    assert_allclose(slope, 1.0, rtol=1e-9)


def test_points_are_where_an_eigenvalue_vanishes() -> None:
    model = lens.Lens(
        halo=lens.Component(profiles.NFW(kappa_s=0.5, r_s=40.0, e=0.4), (0.0, 0.0), 0.5),
        shear=lens.Component(profiles.Shear(gamma=0.05), (0.0, 0.0), 1.0),
    )
    found = critical.curves(model, GRID, 0.9)
    assert len(found.items) == 2
    for one in found.items:
        inverse = np.asarray(jnp.linalg.det(lens.jacobian(model, jnp.asarray(one.theta), 0.9)))
        assert_allclose(inverse, 0.0, atol=1e-9)
        assert_allclose(one.beta, lens.ray_trace(model, jnp.asarray(one.theta), 0.9), atol=1e-12)


def test_a_window_that_cuts_a_curve_says_so() -> None:
    sphere = lens.Lens(one=lens.Component(profiles.SIE(b=10.0), (28.0, 0.0)))
    found = critical.curves(sphere, GRID, 1.0)
    assert found.items
    assert not any(one.closed for one in found.items if one.kind == "tangential")
    assert np.isnan(critical.einstein_radius(found))


def test_a_weak_lens_has_none() -> None:
    weak = lens.Lens(one=lens.Component(profiles.Sheet(kappa=0.1)))
    assert critical.curves(weak, GRID, 1.0).items == ()


def test_published_einstein_radius_of_abell_s1063() -> None:
    """29.62 arcsec, made from a 1.5 arcsec grid by an independent program: 0.3 % is that grid."""
    plane = LensPlane.at(0.3475)
    found = critical.curves(
        datasets.reference_lens("as1063"), Grid.square(120.0, 0.5), float(plane.dls_ds(2.0))
    )
    assert_allclose(critical.einstein_radius(found), 29.62, rtol=3e-3)


def test_bad_ratio_is_named() -> None:
    with pytest.raises(ValueError, match=r"`dls_ds` is 1\.5"):
        critical.curves(lens.Lens(one=lens.Component(profiles.Sheet(kappa=0.1))), GRID, 1.5)
