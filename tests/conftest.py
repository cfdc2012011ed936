"""Double precision, no implicit rank promotion, and the same hypothesis examples on every run.

Warnings are errors and shapes are checked through `[tool.pytest.ini_options]` in pyproject.toml.
"""

import jax
from hypothesis import HealthCheck, Phase, settings

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

# A first example compiles, so no deadline; derandomized, so that a failure is seen by everybody.
settings.register_profile(
    "jaxlens",
    deadline=None,
    derandomize=True,
    database=None,
    max_examples=25,
    phases=[Phase.explicit, Phase.generate, Phase.shrink],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("jaxlens")
