"""glafic input files, both ways: model, galaxies, images and boxes.

`read` turns an input file into a `strong.Problem`, `read_lens` into a lens; `write` puts a lens and
`write_problem` a whole fit into glafic's files. Masses there are in Msun/h and position angles from North
through East of a frame with x to the right; both are converted here. The norms are glafic's own (they
differ from the constants of this package by 3e-5), so that its chi^2 and masses compare digit by digit.
Conventions: Oguri 2010 (PASJ 62, 1017), Oguri 2021 (PASP 133, 074504); the converted fields were
checked against numbers of glafic 2.1.15, the syntax of prior files is quoted from secondary sources.
"""

from jaxlens.glafic._forms import ELLIPSE, GALAXIES, KINDS, ahern, anfw, degrees, point, radians
from jaxlens.glafic._read import GlaficInput, read, read_lens
from jaxlens.glafic._scan import read_observations
from jaxlens.glafic._write import write
from jaxlens.glafic._write_problem import write_problem

__all__ = [
    "ELLIPSE",
    "GALAXIES",
    "KINDS",
    "GlaficInput",
    "ahern",
    "anfw",
    "degrees",
    "point",
    "radians",
    "read",
    "read_lens",
    "read_observations",
    "write",
    "write_problem",
]
