"""The page of a dataset: its numbers are those of the recording, and it can be read without a script."""

import re
from pathlib import Path

import numpy as np
import pytest
from test_matrix import Place

import harness

LAG = 3
"""Number of samples by which the second sensor follows the first."""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """Two objects are squeezed eight times each. The pad follows the bend, and one of three wires is broken."""
    folder = tmp_path_factory.mktemp("dataset-page")
    (folder / "trials").mkdir()
    for number in range(16):
        bend = np.cumsum(np.random.default_rng(number).normal(size=80 + LAG))
        columns = [np.arange(80) / 10, bend[LAG:], bend[:80], np.full(80, 2.5), np.arange(80)]
        path = folder / f"trials/{'ball' if number < 8 else 'cup'}_{number}.csv"
        np.savetxt(path, np.column_stack(columns), "%.6f", ",", header="time,bend,pad,broken,ramp", comments="")
    (folder / "squeeze.yaml").write_text(
        'name: squeeze\nsource: trials\nformat: csv\nsample_rate_hz: 10\nmax_gap_s: 0.3\ntrial: "{object}_{n:int}"\n'
        'streams:\n  all: {time: time, file: "*.csv"}\nsplit: {by: trial}\n'
        "modalities:\n  setpoint: none\n  bend: {from: all.bend, unit: V}\n  pad: {from: all.pad, unit: V}\n"
        "  wires: {from: [all.broken, all.ramp], unit: V}\n"
    )
    place = Place(folder)
    place.succeed("import", "squeeze.yaml")
    return place


def page_of(place: Place, name: str) -> str:
    place.succeed("report", "--dataset", name, "--output", "page.html")
    return (place.folder / "page.html").read_text()


def cells(page: str, row: str) -> list[str]:
    """The cells of the row with this heading."""
    (found,) = re.findall(rf"<tr><th scope=\"row\">{re.escape(row)}</th>(.*?)</tr>", page, re.DOTALL)
    return re.findall(r"<td>(.*?)</td>", found)


def test_the_page_says_what_was_recorded(place: Place) -> None:
    page = page_of(place, "squeeze")
    assert "<script" not in page and "script-src" not in page
    assert cells(page, "episodes") == ["16, of 8.000 s"] and cells(page, "samples") == ["1280 at 10.00 Hz"]
    counts = {part: [int(cell) for cell in cells(page, part)] for part in ("training", "validation", "test")}
    assert sum(samples for _, samples in counts.values()) == 1280
    assert all(samples == 80 * episodes for episodes, samples in counts.values())
    objects = {name: [int(cell) for cell in cells(page, name)] for name in ("ball", "cup")}
    assert [sum(counts) for counts in objects.values()] == [8, 8]
    assert [sum(counts) for counts in zip(*objects.values(), strict=True)] == [episodes for episodes, _ in counts.values()]
    # A ramp from 0 to 79 in each episode.
    ramp, *_, outside = cells(page, "ramp (V)")
    deviation = np.sqrt((80**2 - 1) / 12)
    assert ramp == f"39.50 ± {deviation:.2f}, 0 to 79.00" and outside == "0.0"
    assert "an element is the same in all training samples: wires[broken]" in page
    (relation,) = re.findall(r"<td>bend</td><td>pad</td><td>(.*?)</td><td>(.*?)</td><td>(.*?)</td>", page)
    assert float(relation[1]) == LAG / 10 and float(relation[2]) > 0.999 > float(relation[0])
    assert page == page_of(place, "squeeze")
    again = harness.report(dataset="squeeze", output=place.folder / "again.html", results=place.folder / "results")
    assert page == again.read_text()
    with pytest.raises(ValueError, match="leave out experiments, where and quick"):
        harness.report("smoke", dataset="squeeze")
    # What the import said.
    assert [cell.strip() for cell in cells(page, "all")[:2]] == ["1280", "10 Hz"] and "V from all.bend" in page


def test_a_wrong_name_ends_in_one_message_without_a_page(place: Place, tmp_path: Path) -> None:
    for name, expected in [
        ("nope", "none of the datasets in results/datasets has a name that begins with 'nope'; there are squeeze-"),
        ("../x", "none of the datasets in results/datasets has a name that begins with '../x'; there are squeeze-"),
    ]:
        answer = place.call("report", "--dataset", name, "--output", str(tmp_path / "no.html"))
        assert answer.returncode != 0 and answer.stderr.startswith(f"error: {expected}"), answer.stderr
    assert not any(tmp_path.iterdir())


def test_an_effect_of_the_day_is_told_where_training_and_test_share_the_days(place: Place) -> None:
    """The sensor has another offset on each of three days. The object has no effect."""
    (place.folder / "days").mkdir()
    for number in range(24):
        generator = np.random.default_rng(number)
        bend = 3 * (number % 3) + generator.normal(size=80)
        name = f"days/{['ball', 'cup'][number // 12]}_{number}_{number % 3}.csv"
        columns = [np.arange(80) / 10, bend, generator.normal(size=80)]
        np.savetxt(place.folder / name, np.column_stack(columns), "%.6f", ",", header="time,bend,pad", comments="")
    mapping = (
        'name: days\nsource: days\nformat: csv\nsample_rate_hz: 10\nmax_gap_s: 0.3\ntrial: "{object}_{n:int}_{day:int}"\n'
        'streams:\n  all: {time: time, file: "*.csv"}\nsplit: {by: SPLIT}\n'
        "modalities:\n  setpoint: none\n  bend: {from: all.bend, unit: V}\n  pad: {from: all.pad, unit: V}\n"
    )
    told = {}
    for split in ("trial", "time, gap_seconds: 0.5", "day"):
        (place.folder / "days.yaml").write_text(mapping.replace("SPLIT", split))
        answer = place.call("import", "days.yaml")
        assert answer.returncode == 0, answer.stderr
        told[split] = re.findall(r"\d+ % of the variance of (\w+) .* label (\w+),", answer.stderr)
    assert told == {"trial": [("bend", "day")], "time, gap_seconds: 0.5": [("bend", "day")], "day": []}
