"""Lenstool parameter files (`.par`), both ways: potentials, limits, member galaxies, images.

`read` turns a parameter file into a `strong.Problem`, `read_lens` into a lens; `write` and `write_problem`
are the other way. x points West and y North of the reference point, angles are degrees from +x,
strengths are for D_LS/D_S = 1; the files share this with the package.

What is known about the format, and from where: the dPIE (profil 81), the scaling of member galaxies and the
external shear (profil 14) reproduce published models of four clusters, through a table of check points
computed by an independent implementation of their definitions; that the `_kpc` radius wins over the one
in arcsec follows from a published input and its result. Everything else (profil 1, 8 and 12, `limit` 1 and 3,
`z_m_limit`, the exponents 1/vdslope and 2/slope, the projection x = -(RA - RA0) cos(Dec0), how images are
grouped by their names) is quoted from secondary sources, not checked against the original.
"""

from jaxlens.lenstool._read import LenstoolModel, read, read_lens
from jaxlens.lenstool._write import write
from jaxlens.lenstool._write_problem import write_problem

__all__ = ["LenstoolModel", "read", "read_lens", "write", "write_problem"]
