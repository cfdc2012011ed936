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
        theta, `(n, 2)`, arcsec.
    """
    ra, dec = np.deg2rad(np.asarray(ra_deg, float)), np.deg2rad(np.asarray(dec_deg, float))
    ra0, dec0 = np.deg2rad(reference)
    depth = np.sin(dec0) * np.sin(dec) + np.cos(dec0) * np.cos(dec) * np.cos(ra - ra0)
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
