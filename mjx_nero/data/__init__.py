"""Data sets of episodes on disk: their schema, their file formats, and one reader. Imports neither JAX nor MuJoCo."""

from mjx_nero.data.dataset import check_writable, open_dataset, open_with, writer
from mjx_nero.data.episode import Dataset, Episode, Feature, Schema

__all__ = ["Dataset", "Episode", "Feature", "Schema", "check_writable", "open_dataset", "open_with", "writer"]
