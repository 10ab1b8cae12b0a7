"""What senses are worth together and alone, on recordings where theory says it."""

import json

import numpy as np
import polars as pl
import pytest

import harness
from harness.importing import import_dataset

SPEC = """
name: halves
input: [left, right]
output: [sum]
latent: 8
seeds: 0
tasks: prediction
window: {horizon: 0}
given: each
network: {preset: single_to_multi, hidden: [32], fusion: product}
training: {epochs: 60, batch_size: 50, learning_rate: 0.01, schedule: cosine, modality_dropout: 0.3, kl_weight: 0.0001}
split: {by: trial, validation: 0.1, test: 0.2}
"""
R2 = """
    select coalesce(given, 'both') as given, value from all_metrics
    where experiment = 'halves' and model = 'network' and metric = 'r2' and index is null
"""


def test_two_senses_that_each_see_half_of_the_answer_have_a_synergy_of_half_of_its_variance(tmp_path):
    """The sum of two independent values of equal variance: each explains 0.5 of it, and both all of it."""
    (tmp_path / "rec").mkdir()
    random = np.random.default_rng(0)
    for trial in range(10):
        left, right = random.normal(size=(2, 400))
        table = pl.DataFrame({"t": np.arange(400) / 10, "left": left, "right": right, "sum": left + right})
        table.write_csv(tmp_path / f"rec/{trial}.csv")
    mapping = {
        "name": "toy",
        "source": "rec",
        "format": "csv",
        "sample_rate_hz": 10,
        "max_gap_s": 1,
        "streams": {"all": {"file": "*.csv", "time": "t"}},
        "modalities": {"setpoint": "none"} | {name: f"all.{name}" for name in ("left", "right", "sum")},
    }
    (tmp_path / "toy.yaml").write_text(json.dumps(mapping))
    dataset = import_dataset(tmp_path / "toy.yaml", tmp_path / "results", progress=False)
    (tmp_path / "halves.yaml").write_text(f"scenarios: [{dataset}]{SPEC}")
    harness.run(tmp_path / "halves.yaml", results=tmp_path / "results", progress=False)
    r2 = dict(harness.query(R2, results=tmp_path / "results").rows())
    alone = max(r2["left"], r2["right"])
    assert r2["left"] == pytest.approx(0.5, abs=0.06) and r2["right"] == pytest.approx(0.5, abs=0.06)
    assert r2["both"] - alone == pytest.approx(0.5, abs=0.06)
