"""Policies on machines without JAX or MuJoCo: numpy, and a runtime for the network."""
