"""Files: catalogues in, results out. Units are converted here and in no other place.

Every writer replaces its file in one step: a reader sees the old file or the new one, never half of one.
"""

from jaxlens.io._blocks import BlockFiles
from jaxlens.io._catalogues import ImageTable, MemberTable, read_images, read_members
from jaxlens.io._files import Staging, atomic, staging, writable
from jaxlens.io._halos import read_lenstool_halos
from jaxlens.io._lens import read_lens, read_lens_labels, read_lens_reference, write_lens
from jaxlens.io._maps import CubeFile, MapFile, read_cube, read_map, write_cube, write_map
from jaxlens.io._shear import (
    Places,
    ShearFile,
    ShearTable,
    read_places,
    read_shear,
    read_shear_map,
    write_shear_map,
)
from jaxlens.io._sky import Reference, north, offsets, sky
from jaxlens.io._table import UNITS, Rows, read_table, unit_of
from jaxlens.io._write import (
    REGION_COLOURS,
    read_json,
    write_array_table,
    write_json,
    write_parquet,
    write_regions,
    write_table,
)

__all__ = [
    "REGION_COLOURS",
    "UNITS",
    "BlockFiles",
    "CubeFile",
    "ImageTable",
    "MapFile",
    "MemberTable",
    "Places",
    "Reference",
    "Rows",
    "ShearFile",
    "ShearTable",
    "Staging",
    "atomic",
    "north",
    "offsets",
    "read_cube",
    "read_images",
    "read_json",
    "read_lens",
    "read_lens_labels",
    "read_lens_reference",
    "read_lenstool_halos",
    "read_map",
    "read_members",
    "read_places",
    "read_shear",
    "read_shear_map",
    "read_table",
    "sky",
    "staging",
    "unit_of",
    "writable",
    "write_array_table",
    "write_cube",
    "write_json",
    "write_lens",
    "write_map",
    "write_parquet",
    "write_regions",
    "write_shear_map",
    "write_table",
]
