"""Arms in software that speak the real ones' protocols, with MuJoCo behind them."""
