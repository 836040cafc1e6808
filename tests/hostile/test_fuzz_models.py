"""Mutations of robots, models and meshes: five minutes, or half of ``MJX_NERO_FUZZ_MINUTES`` (``test_fuzz.py`` has the rest)."""

import fuzz
import pytest

MODELS = ("robot", "model", "model_in_folder", "mesh_in_folder", "stl", "obj", "dae", "urdf")


@pytest.mark.slow
def test_readers_of_models(campaign):
    campaign(MODELS)


@pytest.mark.parametrize("name", MODELS)
def test_a_good_file_is_taken(name):
    """What a campaign starts from is fit to be used."""
    assert any(fuzz.judge(name, content) for content in fuzz.corpus(name))
