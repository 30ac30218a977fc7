import jax


jax.config.update("jax_enable_x64", True)
# Broadcasts between ranks and mixtures of dtypes in the package are oversights.
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
