"""Cloning: a policy from demonstrations alone."""
