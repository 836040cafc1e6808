"""Data sets of episodes on disk: their schema, the forms that they are written in, and one reader. Neither JAX nor MuJoCo."""

from mjx_nero.data.dataset import open_dataset, writer
from mjx_nero.data.episode import Dataset, Episode, Feature, Schema

__all__ = ["Dataset", "Episode", "Feature", "Schema", "open_dataset", "writer"]
