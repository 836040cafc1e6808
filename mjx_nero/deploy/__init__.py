"""Runs policies on machines without JAX or MuJoCo, with numpy and a runtime for the network."""
