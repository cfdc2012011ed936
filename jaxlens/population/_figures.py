"""The figures of a population."""

from collections.abc import Mapping, Sequence
from typing import Any

from jaxlens import plotting, reproduce
from jaxlens.population._report import success_rates
from jaxlens.population._table import applicable, columns, profiles


def figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures by name; of clusters that all failed only that of the shares.

    Args:
        rows: from `run` or `shipped`.
    """
    statements = {"statements": reproduce.tally(applicable(rows))}
    drawn = {"shares": plotting.statement_shares(*reproduce.shares(statements))}
    whole = columns(rows)
    good = whole["failed"] == ""
    if not good.any():
        return drawn
    table, found = {name: values[good] for name, values in whole.items()}, profiles(rows)
    bias, inner = (table["lambda_rec"] / table[name] - 1.0 for name in ("lambda_true", "lambda_true_inner"))
    properties = {
        "concentration": table["concentration"],
        "substructure fraction": table["substructure_fraction"],
        "multiple-image systems": table["n_systems"],
        r"$n_0$ [arcmin$^{-2}$]": table["n0_arcmin2"],
    }
    return drawn | {
        "transition": plotting.transition_against(
            properties,
            table["transition_kpc_h"],
            table["transition_lo_kpc_h"],
            table["transition_hi_kpc_h"],
            table["shape_crossing_kpc_h"],
        ),
        "lambda_bias": plotting.lambda_bias(
            table["lambda_sl"], bias, table["lambda_rec_scatter"] / table["lambda_true"], inner=inner
        ),
        "success": plotting.success(*success_rates(table)),
        "profiles": plotting.many_profiles(
            found["r_kpc_h"][0], found["lambda_rec"] / table["lambda_true"][:, None]
        ),
    }
