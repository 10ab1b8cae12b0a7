"""Recordings from elsewhere as datasets of the harness, and trained on by it."""

import fcntl
import io
import json
import shutil
from pathlib import Path

import numpy as np
import polars as pl
import polars.selectors as cs
import pytest
from conftest import ROOT, SPEC
from PIL import Image

import harness as harness_package
from harness.importing import import_dataset
from harness.recorded import RecordedDataset, vector_columns

PARQUET = {"format": "parquet", "episode": "episode", "order": "sample", "sample_rate_hz": 10}
PARQUET |= {"split": {"by": "episode"}}
ITSELF = {
    "setpoint": "setpoint_*",
    "proprioception": "proprioception_*",
    "arm": ["arm_rotation", "arm_lift", "arm_extension"],
    "contact_force": "contact_force_??",
    "contact_force_mean": "contact_force_mean_*",
    "vision": "vision",
}
"""The harness's own files, as any Parquet files."""


def write_mapping(folder: Path, source: Path, modalities: dict, **settings) -> Path:
    path = folder / "mapping.yaml"
    mapping = {"name": "lab_finger", "source": str(source), "modalities": modalities} | settings
    path.write_text(json.dumps({key: mapping[key] for key in sorted(mapping) if mapping[key] is not None}))
    return path


def read_episodes(folder: Path) -> list[pl.DataFrame]:
    """The episodes, without labels and without what `ITSELF` does not import."""
    episodes = [pl.read_parquet(path) for path in sorted(folder.glob("episode_*.parquet"))]
    known = ("setpoint_", "proprioception_", "arm_r", "arm_l", "arm_e", "contact_force_")
    simulated = cs.starts_with("contact_force_kind_") | cs.starts_with("contact_force_normal")
    own = cs.by_name("dataset", "scenario", "episode", "sample", "time", "vision") | cs.starts_with(*known)
    return [episode.select(own - simulated) for episode in episodes]


def metrics(results: Path) -> pl.DataFrame:
    (path,) = results.glob("runs/smoke/*/metrics.parquet")
    key = ["task", "model", "modality", "direction", "index", "metric"]
    return pl.read_parquet(path).select(*key, "value").sort(key)


def test_what_comes_back_by_parquet_equals_and_trains_the_same(dataset, harness, tmp_path):
    name = import_dataset(
        write_mapping(tmp_path, dataset, ITSELF, **PARQUET), harness.results, progress=False
    )
    folder = harness.results / "datasets" / name
    for original, imported in zip(read_episodes(dataset), read_episodes(folder), strict=True):
        labels = ["dataset", "scenario"]
        assert imported.drop(labels).equals(original.drop(labels)) and imported.schema == original.schema
        assert imported["dataset"].unique().to_list() == [name]
    answer = harness("run", SPEC, f"scenarios=[{name}]")
    assert answer.returncode == 0 and "1 done" in answer.stdout, answer.stderr
    of_parts = pl.col("metric").str.starts_with("relative_error_")
    of_kinds = pl.col("metric").str.contains("_(none|ground|box)$")
    original, found = metrics(dataset.parents[1]), metrics(harness.results)
    assert len(original.filter(of_kinds)) > 0
    original = original.filter(~of_kinds)
    assert len(original) > 900 and found.filter(~of_parts).equals(original.filter(~of_parts))
    # Only a simulated dataset says by which colors its frames tell the robot's parts.
    assert len(found.filter(of_parts)) == 0 and len(original.filter(of_parts)) == 6
    assert harness("verify").returncode == 0
    # Each command that reads results takes the run. An imported dataset has no seed.
    files = [str(tmp_path / name) for name in ("report.html", "figures", "plot.svg")]
    for command in (
        ["report", "smoke", "--output", files[0]],
        ["figures", "regression", "prediction_results", "--experiment", "smoke", "--output", files[1]],
        ["plot", "smoke", "--x", "latent", "--metrics", "r2", "--by", "modality", "--output", files[2]],
        ["compare", "smoke", "--against", "persistence"],
    ):
        answer = harness(*command)
        assert answer.returncode == 0, (command, answer.stderr)
    data = json.loads(Path(files[0]).read_text().split('id="data">')[1].split("</script>")[0])
    clouds = [cloud for cloud in data["regression"] if cloud["modality"] == "proprioception"]
    wanted = found.filter(model="network", task="prediction", modality="proprioception", metric="r2")
    wanted = dict(wanted.drop_nulls("index").select("index", "value").iter_rows())
    assert clouds and all(cloud["r2"] == [pytest.approx(wanted[cloud["index"]], rel=1e-4)] for cloud in clouds)
    assert any(any(series["values"]) for series in data["joints"])
    # Once imported, it is not imported again.
    before = folder.stat().st_mtime_ns
    assert import_dataset(tmp_path / "mapping.yaml", harness.results, progress=False) == name
    assert folder.stat().st_mtime_ns == before


def test_what_comes_back_by_lerobot_has_the_same_numbers(dataset, harness, tmp_path):
    pytest.importorskip("lerobot", reason="lerobot is not installed; it needs Python 3.12: make interchange")
    from harness.export import export

    source = export(dataset, "lerobot", tmp_path / "exported", progress=False)
    modalities = {
        "setpoint": "observation.setpoint",
        "proprioception": "observation.state[0:20]",
        "arm": "observation.state[20:23]",
        "contact_force": "observation.contact_force",
        "contact_force_mean": "observation.contact_force_mean",
        "vision": "observation.images.external",
    }
    mapping = write_mapping(tmp_path, source, modalities, format="lerobot")
    name = import_dataset(mapping, harness.results, progress=False)
    originals, imports = read_episodes(dataset), read_episodes(harness.results / "datasets" / name)
    for original, imported in zip(originals, imports, strict=True):
        left_out = ["dataset", "scenario", "vision"]
        assert imported.drop(left_out).equals(original.select(imported.columns).drop(left_out))
        frames = [np.frombuffer(b"".join(episode["vision"]), np.uint8) for episode in (original, imported)]
        assert np.abs(frames[0].astype(int) - frames[1]).mean() < 1.5
    answer = harness("run", SPEC, f"scenarios=[{name}]")
    assert answer.returncode == 0, answer.stderr
    # An action leads to the next sample, and nobody knows which one led to the first.
    mapping = write_mapping(tmp_path, source, modalities | {"setpoint": "action"}, format="lerobot")
    imports = read_episodes(harness.results / "datasets" / import_dataset(mapping, harness.results, progress=False))
    for original, imported in zip(originals, imports, strict=True):
        left_out = ["dataset", "scenario", "sample", "time", "vision"]
        assert imported.drop(left_out).equals(original.select(imported.columns).drop(left_out)[1:])
        assert imported["sample"].equals(original["sample"][:-1]) and imported["time"].equals(original["time"][:-1])
        frames = [np.frombuffer(b"".join(frames), np.uint8) for frames in (original["vision"][1:], imported["vision"])]
        assert np.abs(frames[0].astype(int) - frames[1]).mean() < 1.5


def test_a_damaged_lerobot_dataset_is_an_error(dataset, harness, tmp_path):
    pytest.importorskip("lerobot", reason="lerobot is not installed; it needs Python 3.12: make interchange")
    from harness.export import export

    source = export(dataset, "lerobot", tmp_path / "exported", progress=False)
    modalities = {"setpoint": "action", "vision": "observation.images.external"}
    mapping = write_mapping(tmp_path, source, modalities, format="lerobot")
    (video,) = source.glob("videos/observation.images.external/**/*.mp4")
    video.write_bytes(video.read_bytes()[:5000])
    with pytest.raises(ValueError, match="source: LeRobot can't read .*exported"):
        import_dataset(mapping, harness.results, progress=False)
    info = source / "meta/info.json"
    info.write_text(info.read_text().replace("v3.0", "v2.1"))
    with pytest.raises(ValueError, match="source: LeRobot can't read .*exported"):
        import_dataset(mapping, harness.results, progress=False)
    info.unlink()
    with pytest.raises(ValueError, match="is no LeRobot dataset: it has no meta/info.json"):
        import_dataset(mapping, harness.results, progress=False)
    assert not harness.results.exists()


def robot_rows(episode: int, samples: int, generator: np.random.Generator) -> pl.DataFrame:
    """What a real robot may have recorded: degrees, millimeters, lists, pictures as PNG, and no mean forces."""
    pictures = []
    for sample in range(samples):
        # Left half of one color, right half of another; the colors tell episode and sample.
        picture = np.zeros((96, 128, 3), np.uint8)
        picture[:, :64], picture[:, 64:] = (episode * 10, sample, 200), (0, sample, 9)
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "PNG")
        pictures.append(buffer.getvalue())
    degrees = generator.uniform(-60, 60, (samples, 20))
    return pl.DataFrame(
        {
            "trial": [f"trial {episode}"] * samples,
            "seconds": np.arange(samples) / 5,
            "angles": degrees.tolist(),
            "rotation": generator.uniform(150, 200, samples),
            "lift": generator.uniform(-900, 0, samples),
            "extension": generator.uniform(0, 1400, samples),
            "command": generator.uniform(-1, 1, (samples, 5)).tolist(),
            "camera": [{"bytes": picture, "path": None} for picture in pictures],
        }
    )


ROBOT = {
    "setpoint": "command[1:4]",
    "proprioception": {"from": "angles", "scale": float(np.pi / 180)},
    "arm": {"from": ["rotation", "lift", "extension"], "scale": [float(np.pi / 180), 0.001, 0.001]},
    "vision": "camera",
}
TRIALS = {"format": "parquet", "episode": "trial", "order": "seconds", "sample_rate_hz": 5}
LENGTHS = [9, 12, 2, 7]


@pytest.fixture
def recordings(tmp_path) -> Path:
    """A folder of files, of which the second has its rows in disorder."""
    folder, generator = tmp_path / "recordings", np.random.default_rng(0)
    folder.mkdir()
    rows = [robot_rows(episode, samples, generator) for episode, samples in enumerate(LENGTHS)]
    rows[0].write_parquet(folder / "a.parquet")
    pl.concat(rows[1:]).sample(fraction=1, shuffle=True, seed=0).write_parquet(folder / "b.parquet")
    return folder


def test_a_robots_recordings_are_converted_and_trained_on(recordings, harness, tmp_path):
    mapping = write_mapping(tmp_path, recordings, ROBOT, **TRIALS)
    name = import_dataset(mapping, harness.results, progress=False)
    source = pl.read_parquet(recordings / "*.parquet").sort("trial", "seconds")
    episodes = read_episodes(harness.results / "datasets" / name)
    assert [len(episode) for episode in episodes] == LENGTHS
    table = pl.concat(episodes)
    np.testing.assert_allclose(table["time"].to_numpy(), source["seconds"].to_numpy())
    layout = json.loads((harness.results / "datasets" / name / "dataset.json").read_text())["imported"]["layout"]
    values = {
        vector: table.select(column.name for column in columns).to_numpy()
        for vector, columns in vector_columns(layout).items()
    }
    angles = np.radians(np.array(source["angles"].to_list()))
    np.testing.assert_allclose(values["proprioception"], angles, rtol=1e-6)
    np.testing.assert_allclose(values["arm"][:, 0], np.radians(source["rotation"].to_numpy()), rtol=1e-6)
    np.testing.assert_allclose(values["arm"][:, 1], source["lift"].to_numpy() / 1000, rtol=1e-6)
    commands = np.array(source["command"].to_list())[:, 1:4]
    np.testing.assert_array_equal(values["setpoint"], commands.astype(np.float32))
    assert "contact_force_07" not in table.columns, "nothing was recorded, so nothing is told"
    frame = np.frombuffer(episodes[3]["vision"][5], np.uint8).reshape(64, 64, 3)
    assert (frame[:, :32] == [30, 5, 200]).all() and (frame[:, 32:] == [0, 5, 9]).all()
    assert harness("verify").returncode == 0
    settings = [f"scenarios=[{name}]", "output=[proprioception,arm,frame_difference]"]
    answer = harness("run", SPEC, *settings)
    assert answer.returncode == 0, answer.stderr
    data = harness_package.Dataset(harness.results / "datasets" / name)
    assert data.keys() == ["proprioception", "arm", "setpoint", "vision"]
    assert (data.scenario, data.sample_rate_hz, data.seed) == (name, 5.0, None)
    np.testing.assert_array_equal(data["proprioception"], values["proprioception"])
    np.testing.assert_array_equal(data.episode(3)["vision"][5], frame)
    with pytest.raises(KeyError, match="has no 'contact_force' in memory; it has proprioception, arm"):
        data["contact_force"]
    (forces,) = harness.results.glob("runs/smoke/*/forces.parquet")
    assert len(pl.read_parquet(forces)) == 0, "a force that wasn't recorded has no distribution"
    sql = "select scenario, count(*) as samples from episodes group by scenario"
    answer = harness("query", sql, "--output", str(tmp_path / "answer.json"))
    assert answer.returncode == 0, answer.stderr
    assert json.loads((tmp_path / "answer.json").read_text()) == [
        {"scenario": name, "samples": sum(LENGTHS)}
    ]


def test_the_name_follows_from_the_content_alone(recordings, harness, tmp_path):
    mapping = write_mapping(tmp_path, recordings, ROBOT, **TRIALS)
    first = import_dataset(mapping, harness.results, progress=False)
    assert import_dataset(mapping, tmp_path / "elsewhere", progress=False) == first
    changed = ROBOT | {"proprioception": {"from": "angles", "scale": 0.5}}
    mapping = write_mapping(tmp_path, recordings, changed, **TRIALS)
    second = import_dataset(mapping, harness.results, progress=False)
    assert second != first and second.startswith("lab_finger-")


def test_what_a_killed_import_left_is_removed_by_the_next(recordings, harness, tmp_path):
    mapping = write_mapping(tmp_path, recordings, ROBOT, **TRIALS)
    left, held = (harness.results / f".unfinished-import-{name}" for name in ["left", "held"])
    for folder in [left, held]:
        folder.mkdir(parents=True)
        (folder / "episode_00000.parquet").write_bytes(b"a part")
    with open(held / ".unfinished-lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        name = import_dataset(mapping, harness.results, progress=False)
        assert not left.exists() and held.exists()
        assert (harness.results / "datasets" / name).is_dir()
    assert [path.name for path in harness.results.glob(".unfinished-*")] == [held.name]


def test_a_shifted_setpoint_belongs_to_the_next_row(recordings, harness, tmp_path):
    shifted = ROBOT | {"setpoint": {"from": "command[1:4]", "shift": 1}}
    mapping = write_mapping(tmp_path, recordings, shifted, **TRIALS)
    with pytest.raises(ValueError, match="episode 2: it has 1 sample after its first row, which is left out; it must"):
        import_dataset(mapping, harness.results, progress=False)
    rows = pl.read_parquet(recordings / "b.parquet").filter(pl.col("trial") != "trial 2")
    rows.write_parquet(recordings / "b.parquet")
    folders = []
    for modalities in (ROBOT, shifted):
        mapping = write_mapping(tmp_path, recordings, modalities, **TRIALS)
        folders.append(harness.results / "datasets" / import_dataset(mapping, harness.results, progress=False))
    setpoint = [f"setpoint_{element}" for element in ("rotation", "lift", "extension")]
    labels = ["dataset", "scenario", "sample", "time"]
    for own, next_row in zip(*map(read_episodes, folders), strict=True):
        assert next_row.select(setpoint).equals(own.select(setpoint)[:-1])
        assert next_row.drop(*setpoint, *labels).equals(own.drop(*setpoint, *labels)[1:])
        assert next_row["time"].equals(own["time"][:-1])


def test_a_unit_may_have_letters_beyond_ascii(recordings, harness, tmp_path):
    own = ROBOT | {"temperature": {"from": "angles[0:1]", "unit": "°C"}}
    name = import_dataset(write_mapping(tmp_path, recordings, own, **TRIALS), harness.results, progress=False)
    answer = harness("verify")
    assert answer.returncode == 0, answer.stdout
    data = harness_package.Dataset(harness.results / "datasets" / name)
    assert data["temperature"].shape == (sum(LENGTHS), 1)
    settings = ["input=[arm]", "output=[temperature]"]
    answer = harness("run", SPEC, f"scenarios=[{name}]", *settings)
    assert answer.returncode == 0 and "1 done" in answer.stdout, answer.stderr
    (path,) = harness.results.glob("runs/smoke/*/metrics.parquet")
    assert "°C" in pl.read_parquet(path)["unit"].to_list()


def test_what_an_imported_dataset_lacks_is_refused_before_work(recordings, harness, tmp_path):
    mapping = write_mapping(tmp_path, recordings, ROBOT, **TRIALS)
    name = import_dataset(mapping, harness.results, progress=False)
    answer = harness("run", SPEC, f"scenarios=[{name}]")
    assert answer.returncode == 2
    assert f"the dataset {name} contains no contact_force" in answer.stderr
    assert "it contains proprioception, arm, vision, frame_difference" in answer.stderr
    inputs = ["input=[arm]", "vary={output: [[arm], [contact_force]]}"]
    answer = harness("run", SPEC, f"scenarios=[{name}]", *inputs)
    assert answer.returncode == 2 and f"the dataset {name} contains no contact_force" in answer.stderr
    answer = harness("run", SPEC, "scenarios=[lab_finger-0123456789abcdef]")
    assert answer.returncode == 2 and "there is no imported dataset" in answer.stderr
    assert "harness import MAPPING.yaml" in answer.stderr
    with pytest.raises(ValueError, match="was imported; only simulated datasets are exported"):
        RecordedDataset(harness.results / "datasets" / name)


def test_episodes_shorter_than_the_window_are_told_or_refused(recordings, harness, tmp_path):
    generator = np.random.default_rng(0)
    rows = [robot_rows(episode, samples, generator) for episode, samples in enumerate([3, 9, 12, 7])]
    (recordings / "b.parquet").unlink()
    pl.concat(rows).write_parquet(recordings / "a.parquet")
    mapping = write_mapping(tmp_path, recordings, ROBOT, **TRIALS)
    name = import_dataset(mapping, harness.results, progress=False)
    settings = [f"scenarios=[{name}]", "input=[arm]", "output=[arm]", "tasks=[prediction]"]

    too_long = {"window.context": 10, "window.horizon": 3}
    words = f"the longest episode of the dataset {name} has 12 samples, and a window of 10 that are seen and 3 that "
    words += "are predicted needs 13; lower window.context or window.horizon, or import longer episodes"
    answer = harness("run", SPEC, *settings, *(f"{key}={value}" for key, value in too_long.items()))
    assert answer.returncode == 2 and words in answer.stderr
    assert not (harness.results / "runs").exists(), "it is refused before work"
    with pytest.raises(ValueError, match=words):
        overrides = too_long | {"scenarios": [name], "input": ["arm"], "output": ["arm"]}
        harness_package.run(ROOT / SPEC, overrides, results=harness.results, progress=False)

    short = f"1 of 4 episodes of {name} are shorter than a window of 4 and 1 samples; they are not used"
    for more, unused in [
        (["window.context=4"], " for the test, nor to train a network with memory"),
        (["window.context=4", "window.start=rest", "network.memory=gru"], " to train a network with memory"),
        (["window.context=4", "split.by=sample"], ""),
    ]:
        answer = harness("run", SPEC, *settings, *more)
        assert answer.returncode == 0, answer.stderr
        assert f"{short}{unused}\n" in answer.stderr
    answer = harness("run", SPEC, *settings)
    assert answer.returncode == 0 and "shorter than" not in answer.stderr


def test_another_import_can_be_the_test(recordings, harness, tmp_path):
    load = {"from": "angles[0:2]", "unit": "N"}

    def imported(name: str, **others) -> str:
        (folder := tmp_path / name).mkdir()
        own = {key: source for key, source in (ROBOT | {"load": load} | others).items() if source}
        mapping = write_mapping(folder, recordings, own, **(TRIALS | {"name": name}))
        return import_dataset(mapping, harness.results, progress=False)

    monday, friday = imported("monday"), imported("friday")
    run = ["run", SPEC, f"scenarios=[{monday}]", "input=[arm]", "output=[proprioception]", "tasks=[prediction]"]
    answer = harness(*run, f"test.dataset={friday}")
    assert answer.returncode == 0 and "1 done, 0 done before" in answer.stdout, answer.stderr
    assert "1 done before" in harness(*run, f"test.dataset={friday}").stdout
    (folder,) = harness.results.glob("runs/smoke/*/")
    tested = pl.read_parquet(folder / "predictions.parquet").group_by("episode").agg(pl.n_unique("sample"))
    assert tested.sort("episode").rows() == [(place, samples - 1) for place, samples in enumerate(LENGTHS)]
    assert json.loads((folder / "run.json").read_text())["test_dataset"] == friday
    for other, difference in [
        (imported("blind", vision=None), "{} has no vision"),
        (imported("warm", temperature=load), "{} also has temperature"),
        (imported("single", load=load | {"from": "angles[0:1]"}), "load of {} has 1 value instead of 2"),
        (imported("newton", load=load | {"unit": "kN"}), "element 0 of load of {} is '00' in 'kN' instead of '00' in 'N'"),
    ]:
        answer = harness(*run, f"test.dataset={other}")
        said = f"{difference.format(other)}, so it can't be the test"
        assert answer.returncode == 2 and said in answer.stderr, answer.stderr

    copy = type(harness)(tmp_path / "copy")
    answer = harness("publish", "smoke", "--complete", "--output", str(copy.results))
    assert answer.returncode == 0 and copy("verify").returncode == 0, answer.stderr
    assert sorted(path.name for path in (copy.results / "datasets").iterdir()) == sorted([monday, friday])
    assert harness("verify").returncode == 0
    shutil.rmtree(harness.results / "datasets" / friday)
    answer = harness("verify")
    assert answer.returncode == 1 and friday in answer.stdout and "import it again" in answer.stdout


def test_a_damaged_or_lost_episode_is_found_and_not_trained_on(recordings, harness, tmp_path):
    mapping = write_mapping(tmp_path, recordings, ROBOT, **TRIALS)
    name = import_dataset(mapping, harness.results, progress=False)
    folder = harness.results / "datasets" / name
    path = folder / "episode_00001.parquet"
    whole = path.read_bytes()
    run = ["run", SPEC, f"scenarios=[{name}]", "output=[proprioception]"]
    path.write_bytes(whole[:2000] + bytes([whole[2000] ^ 1]) + whole[2001:])
    for problem in ("SHA-256 differs", "missing"):
        answer = harness("verify")
        assert answer.returncode == 1 and problem in answer.stdout
        assert "import its mapping again" in answer.stdout
        answer = harness(*run)
        assert answer.returncode == 1 and "episode_00001.parquet" in answer.stderr, answer.stderr
        path.unlink(missing_ok=True)
    path.write_bytes(whole)
    assert harness("verify").returncode == 0
    description = folder / "dataset.json"
    description.write_text(description.read_text().replace('"samples": 9', '"samples": 8'))
    assert "it does not describe this dataset" in harness("verify").stdout
    assert "it does not describe this dataset" in harness(*run).stderr


def without(section: dict, key: str) -> dict:
    return {name: value for name, value in section.items() if name != key}


@pytest.mark.parametrize(
    ("changes", "modalities", "words"),
    [
        ({"sorce": "x"}, {}, r"mapping.yaml:1:\d+: unknown key 'sorce'; did you mean 'source'\?"),
        ({"episode": "run"}, {}, "there is no column 'run'; the columns are trial, seconds, angles"),
        ({"order": "trial"}, {}, "order: two rows of an episode have the same 'trial'"),
        ({}, {"touch": "x"}, "modalities.touch: there is no column 'x'; the columns are trial"),
        (
            {},
            {"arm_lift": {"from": "camera", "size": [8, 8]}},
            "modalities.arm_lift: a vector has a column of this name; give the image another name",
        ),
        ({}, {"setpoint": "order"}, "modalities.setpoint: there is no column 'order'; the columns are trial"),
        (
            {},
            {"setpoint": "command[1:"},
            r"modalities.setpoint: 'command\[1:' is not understood; write COLUMN",
        ),
        ({}, {"setpoint": "command[2:2]"}, r"episode 0: modalities.setpoint: command\[2:2\] gives no values"),
        (
            {},
            {"setpoint": "command[3:6]"},
            r"modalities.setpoint: command\[3:6\] goes beyond the end of 'command'; all of it is command\[0:5\]",
        ),
        (
            {},
            {"arm": ["command[0:2]", "lift[1]"]},
            r"arm: lift\[1\] goes beyond the end of 'lift'; all of it is lift\[0:1\]",
        ),
        ({}, {"setpoint": "trial"}, "modalities.setpoint: 'trial' holds no numbers"),
        ({}, {"arm": {"from": "command[0:3]", "scale": [1, 2]}}, "modalities.arm: scale: must be 1 number or 3, not 2"),
        ({}, {"vision": "trial"}, "modalities.vision: a value is no picture"),
        (
            {},
            {"vision": "*a*"},
            r"modalities.vision: must be one whole column, not \*a\*, which matches trial, angles, .*camera",
        ),
        (
            {},
            {"vision": "camera[0:3]"},
            r"modalities.vision: must be one whole column, not camera\[0:3\], which is a part of one",
        ),
        ({}, {"arm": {"from": "command[0:3]", "scale": 1e300}}, "value 0 of row 0 is .*e.29.*; it must be a finite number, at most"),
    ],
)
def test_a_mistake_in_a_mapping_is_an_error_with_its_place(
    recordings, harness, tmp_path, changes, modalities, words
):
    mapping = write_mapping(tmp_path, recordings, **({"modalities": ROBOT | modalities} | TRIALS | changes))
    with pytest.raises(ValueError, match=words):
        import_dataset(mapping, harness.results, progress=False)
    assert not harness.results.exists()


def test_a_key_that_is_there_twice_is_an_error_with_its_place(recordings, harness, tmp_path):
    mapping = write_mapping(tmp_path, recordings, **({"modalities": ROBOT} | TRIALS))
    mapping.write_text(f'{mapping.read_text()[:-1]},\n"name": "other"}}')
    with pytest.raises(ValueError, match="mapping.yaml:2:1: broken YAML: duplicate .*name"):
        import_dataset(mapping, harness.results, progress=False)


def test_no_or_too_short_episodes_are_an_error(recordings, harness, tmp_path):
    (recordings / "a.parquet").unlink()
    rows = pl.read_parquet(recordings / "b.parquet")
    mapping = write_mapping(tmp_path, recordings, ROBOT, **TRIALS)
    for kept, words in [
        (
            rows.filter((pl.col("trial") != "trial 2") | (pl.col("seconds") == 0)),
            "episode 1: it has 1 sample; it must have 2 or more",
        ),
        (rows.clear(), "no episode was found"),
    ]:
        kept.write_parquet(recordings / "b.parquet")
        with pytest.raises(ValueError, match=words):
            import_dataset(mapping, harness.results, progress=False)


def test_what_is_not_there_or_no_such_file_is_an_error(harness, tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere.yaml"):
        import_dataset(tmp_path / "nowhere.yaml", harness.results)
    mapping = write_mapping(tmp_path, tmp_path / "nowhere", ROBOT, **TRIALS)
    with pytest.raises(FileNotFoundError, match="source: .*nowhere is not there"):
        import_dataset(mapping, harness.results)
    (tmp_path / "text.parquet").write_text("no table")
    mapping = write_mapping(tmp_path, tmp_path / "text.parquet", ROBOT, **TRIALS)
    with pytest.raises(ValueError, match="can't be read"):
        import_dataset(mapping, harness.results)
    mapping.write_text("name: [")
    with pytest.raises(ValueError, match="mapping.yaml:1:7: broken YAML"):
        import_dataset(mapping, harness.results)


def test_any_width_and_any_image_is_imported_and_trained_on(recordings, harness, tmp_path):
    """Seven joints, two pads, commands of two elements, and a camera of 32 x 32 pixels under another name."""
    own = {
        "setpoint": "command[0:2]",
        "joints": {"from": "angles[0:7]", "unit": "deg"},
        "pads": "command[1:3]",
        "wrist": {"from": "camera", "size": [32, 32]},
    }
    mapping = write_mapping(tmp_path, recordings, own, **TRIALS)
    name = import_dataset(mapping, harness.results, progress=False)
    data = harness_package.Dataset(harness.results / "datasets" / name)
    assert data["joints"].shape == (sum(LENGTHS), 7) and data["wrist"].shape == (sum(LENGTHS), 32, 32, 3)
    settings = ["input=[joints,wrist]", "output=[joints,pads,wrist_difference]"]
    answer = harness("run", SPEC, f"scenarios=[{name}]", *settings)
    assert answer.returncode == 0 and "1 done" in answer.stdout, answer.stderr
    (path,) = harness.results.glob("runs/smoke/*/metrics.parquet")
    found = pl.read_parquet(path).filter(pl.col("metric") == "rmse")
    units = found.filter(pl.col("modality") == "joints")["unit"].unique().to_list()
    assert units == ["deg"] and found["modality"].n_unique() == 4
