"""Positions on the sky and offsets on the tangent plane."""

import numpy as np

Reference = tuple[float, float]
"""(RA, Dec) of the origin of the frame, degrees."""


def offsets(ra_deg: np.ndarray, dec_deg: np.ndarray, reference: Reference) -> np.ndarray:
    """Gnomonic projection about the reference point: theta_1 towards West, theta_2 towards North.

    With standard coordinates xi (East) and eta (North), theta = (-xi, eta) (Calabretta & Greisen 2002, TAN).

    Args:
        ra_deg, dec_deg: positions, `(n,)`, degrees.
        reference: (RA, Dec) of the origin, degrees.

    Returns:
        theta, `(n, 2)`, arcsec; NaN for positions in the opposite half of the sky, which have no projection.
    """
    ra, dec = np.deg2rad(np.asarray(ra_deg, float)), np.deg2rad(np.asarray(dec_deg, float))
    ra0, dec0 = np.deg2rad(reference)
    depth = np.sin(dec0) * np.sin(dec) + np.cos(dec0) * np.cos(dec) * np.cos(ra - ra0)
    depth = np.where(depth > 0.0, depth, np.nan)
    xi = np.cos(dec) * np.sin(ra - ra0) / depth
    eta = (np.cos(dec0) * np.sin(dec) - np.sin(dec0) * np.cos(dec) * np.cos(ra - ra0)) / depth
    return np.rad2deg(np.stack([-xi, eta], axis=-1)) * 3600.0


def sky(theta: np.ndarray, reference: Reference) -> tuple[np.ndarray, np.ndarray]:
    """The inverse of `offsets`: RA in [0, 360) and Dec, each `(n,)`, degrees, of `theta (n, 2)`, arcsec."""
    theta = np.asarray(theta, float)
    xi, eta = -np.deg2rad(theta[..., 0] / 3600.0), np.deg2rad(theta[..., 1] / 3600.0)
    ra0, dec0 = np.deg2rad(reference)
    along = np.cos(dec0) - eta * np.sin(dec0)
    ra = ra0 + np.arctan2(xi, along)
    dec = np.arctan2(np.sin(dec0) + eta * np.cos(dec0), np.hypot(xi, along))
    return np.rad2deg(ra) % 360.0, np.rad2deg(dec)


def north(ra_deg: np.ndarray, reference: Reference) -> np.ndarray:
    """Direction of local North on the tangent plane of `offsets`: its angle from +theta_2, `(n,)`, rad.

    Meridians converge: away from the reference point, and soon near a pole, a galaxy's own North is turned
    by this angle (from +theta_1 towards +theta_2), and its ellipticity by twice that. It does not depend
    on the declination: meridians are straight lines of this projection.

    Args:
        ra_deg: right ascensions, `(n,)`, degrees.
        reference: (RA, Dec) of the origin, degrees.
    """
    ra0, dec0 = np.deg2rad(reference)
    turn = np.deg2rad(np.asarray(ra_deg, float)) - ra0
    # Derivatives of xi and eta with declination, without their common denominator, a square.
    return np.arctan2(-np.sin(dec0) * np.sin(turn), np.cos(turn))
