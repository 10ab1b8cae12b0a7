"""The delay between two streams, on recordings whose delay is known."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from harness.importing.lag import lags

TERMS = ("angle.x", "force.y")


def recorded(folder: Path, delays_s: list[float], drift: float = 0.0, seconds: float = 40, **force) -> Path:
    """Writes a trial for each delay: a motion at 100 Hz, and at 60 Hz its delayed and inverted copy with noise."""
    (folder / "rec").mkdir(exist_ok=True)
    for trial, delay in enumerate(delays_s):
        random = np.random.default_rng(trial)
        waves = [(random.uniform(0.3, 3), random.uniform(0, 6)) for _ in range(8)]

        def motion(times: np.ndarray, waves=waves) -> np.ndarray:
            return np.sum([np.sin(2 * np.pi * rate * times + phase) for rate, phase in waves], axis=0)

        slow, fast = np.arange(0, seconds, 1 / 60), np.arange(0, seconds, 0.01)
        noise = random.normal(0, 0.3, len(slow))
        delayed = -3 * motion(slow - delay - drift * slow) + noise
        pl.DataFrame({"t": fast, "x": motion(fast)}).write_csv(folder / f"rec/{trial}_angle.csv")
        pl.DataFrame({"t": slow, "y": delayed}).write_csv(folder / f"rec/{trial}_force.csv")
    streams = {name: {"file": f"*_{name}.csv", "time": "t"} for name in ("angle", "force")}
    streams["force"] |= force
    mapping = {
        "name": "lab",
        "source": "rec",
        "format": "csv",
        "sample_rate_hz": 10,
        "max_gap_s": 1,
        "streams": streams,
    }
    mapping |= {"modalities": {"setpoint": "none", "x": "angle.x", "y": "force.y"}}
    mapping |= {"episodes": "offsets.csv"} if force.get("offset_s") == "offset_s" else {}
    (folder / "lab.yaml").write_text(json.dumps(mapping))
    return folder / "lab.yaml"


def command(folder: Path, *words: str) -> subprocess.CompletedProcess:
    words = (sys.executable, "-m", "harness.importing", "lab.yaml", "--lag", *words)
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)


def test_a_delay_of_70_ms_is_found_and_removed(tmp_path):
    recorded(tmp_path, [0.07, 0.07, 0.07])
    told = command(tmp_path, *TERMS).stdout
    found, half = map(float, re.findall(r"comes ([\d.]+) ms after angle.x, ± ([\d.]+) ms", told)[0])
    assert abs(found - 70) < 2 and half < 3
    (offset,) = re.findall(r"say 'offset_s: (-[\d.]+)' in streams.force", told)
    for lag in lags(recorded(tmp_path, [0.07] * 3, offset_s=float(offset)), TERMS, 1.0):
        assert abs(lag.delay_s) < 0.005 and lag.correlation > 0.9
    assert not (tmp_path / "results").exists()


def test_each_trial_has_its_own_delay_which_a_table_removes(tmp_path):
    delays = [0.07, -0.2, 0.0, 0.31]
    path = recorded(tmp_path, delays)
    found = lags(path, TERMS, 0.5)
    np.testing.assert_allclose([lag.delay_s for lag in found], delays, atol=0.005)
    assert all(abs(lag.delay_s - delay) < 2 * lag.half_s < 0.02 for lag, delay in zip(found, delays, strict=True))
    assert command(tmp_path, *TERMS, "--max-lag", "0.5", "--output", "offsets.csv").returncode == 0
    removed = lags(recorded(tmp_path, delays, offset_s="offset_s"), TERMS, 0.5)
    np.testing.assert_allclose([lag.delay_s for lag in removed], 0, atol=0.005)


def test_a_clock_that_is_too_slow_drifts(tmp_path):
    (lag,) = lags(recorded(tmp_path, [0.05], drift=0.002, seconds=80), TERMS, 0.5)
    assert abs(lag.drift - 0.002) < 3e-4 and lag.drift_half < 6e-4
    (lag,) = lags(recorded(tmp_path, [0.05], seconds=80), TERMS, 0.5)
    assert abs(lag.drift) < 3e-4


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((*TERMS, "--max-lag", "30"), "too short to look for delays of up to 30 s; name a shorter one with --max-lag"),
        (("angle.x", "force.z"), "--lag: there is no column 'force.z'; the columns are angle.x, force.y"),
        (("angle.x", "force.y", "--max-lag", "0"), "--max-lag needs --lag COLUMN COLUMN, and is above 0"),
        ((*TERMS, "--max-lag", "0.02"), "trial 0: no delay of up to 0.02 s fits: "),
    ],
)
def test_a_delay_that_cant_be_found_is_told(tmp_path, words, message):
    recorded(tmp_path, [0.4])
    answer = command(tmp_path, *words)
    assert answer.returncode in (1, 2) and message in answer.stderr.splitlines()[-1]
