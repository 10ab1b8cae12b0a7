"""A world that repeats the setpoints of a recording stands beside the networks, and says how well it matches the robot."""

import re

import polars as pl
import pytest
from test_matrix import Place

from harness.fitting import fit_world

MODEL = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody><body name="cart">
<joint name="x" type="slide" axis="1 0 0" damping="2"/><geom size="0.1" mass="1"/><body name="tail" pos="0 0 -0.2">
<joint name="stretch" type="slide" axis="1 0 0" stiffness="STIFFNESS" damping="0.5"/><joint name="sink" type="slide" axis="0 0 1"/>
<geom name="pad" size="0.02" mass="0.2" friction="FRICTION"/></body></body><geom type="plane" size="1 1 1" pos="0 0 -0.22" friction="0.01"/></worldbody>
<actuator><position name="push" joint="x" kp="60" ctrlrange="-1 1"/></actuator></mujoco>"""

WORLD = """model: NAME.xml
step_rate_hz: 500
sample_rate_hz: 20
modalities:
  place: {joint_positions: x}
  tail: {joint_positions: stretch}
factors:
  stiffness: {joint_stiffness: stretch, scale_by: {log_uniform: [0.1, 10]}}
  friction: {geom_friction: pad, scale_by: {log_uniform: [0.1, 10]}}
action: {seconds: 1, actuators: {push: {actuator: push, unit: m, range: [-1, 1]}}}
"""

SPEC = """name: NAME
scenarios: [SCENARIO]
input: [place]
output: [tail]
latent: 2
tasks: prediction
network: {preset: single_to_multi, hidden: 8}
training: {epochs: 2}
"""


def recorded(place: Place) -> str:
    """Records trials of the robot as CSV files, imports them, and returns the name of the dataset."""
    (place.folder / "spec.yaml").write_text(SPEC.replace("NAME", "made").replace("SCENARIO", "robot.yaml"))
    place.succeed("run", "spec.yaml", "simulation.episodes=8", "simulation.actuations_per_episode=4")
    columns = "episode, time, place_x, tail_stretch, setpoint_push"
    place.succeed("query", f"select {columns} from episodes order by episode, sample", "--output", "all.csv")
    (place.folder / "trials").mkdir()
    for (episode,), rows in pl.read_csv(place.folder / "all.csv").group_by("episode", maintain_order=True):
        rows.drop("episode").write_csv(place.folder / f"trials/{episode}.csv")
    (place.folder / "lab.yaml").write_text(
        "name: lab\nsource: trials\nformat: csv\nsample_rate_hz: 20\nmax_gap_s: 0.2\nsplit: {by: trial, seed: 0}\n"
        'streams: {log: {file: "*.csv", time: time}}\nmodalities:\n  setpoint: log.setpoint_push\n'
        "  place: {from: log.place_x, unit: m}\n  tail: {from: log.tail_stretch, unit: m}\n"
    )
    place.succeed("import", "lab.yaml")
    (dataset,) = (place.folder / "results/datasets").glob("lab-*")
    return dataset.name


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    place = Place(tmp_path_factory.mktemp("replay"))
    for name, stiffness, friction in (("robot", 10, 0.2), ("stiffer", 40, 0.5)):
        model = MODEL.replace("STIFFNESS", str(stiffness)).replace("FRICTION", str(friction))
        (place.folder / f"{name}.xml").write_text(model)
        (place.folder / f"{name}.yaml").write_text(WORLD.replace("NAME", name))
    (place.folder / "real.yaml").write_text(SPEC.replace("NAME", "real").replace("SCENARIO", recorded(place)))
    return place


def r2(place: Place) -> dict[str, float]:
    text = place.succeed("compare", "real", "--metrics", "r2", "--format", "csv")
    (place.folder / "table.csv").write_text(text)
    table = pl.read_csv(place.folder / "table.csv")
    return dict(table.select("model", "mean").iter_rows())


def test_the_right_world_predicts_the_recording_and_another_one_does_not(place: Place) -> None:
    for world in ("robot", "stiffer"):
        place.succeed("judge", "real.yaml", "simulator", "--world", f"{world}.yaml")
    found = r2(place)
    assert found["simulator-robot"] > 0.9999
    assert found["simulator-stiffer"] < 0.8 < found["persistence"] < 0.99


def test_what_does_not_fit_is_one_message(place: Place) -> None:
    """Nothing is written then."""
    (place.folder / "blind.yaml").write_text(WORLD.replace("NAME", "robot").replace("  tail: {joint_positions: stretch}\n", ""))
    before = set((place.folder / "results").rglob("*"))
    for more, expected in [
        ([], r"lab-\w+ was imported, so the state at its samples is not known; name a world .* with --world WORLD"),
        (["--world", "blind.yaml"], r"the output tail is not in the world blind as in lab-\w+: the world senses place"),
        (["--world", "nope"], "unknown world 'nope'"),
        (["--world", "empty"], r"the action of the world empty has the element rotation in rad, and the setpoints of .*"),
    ]:
        answer = place.call("judge", "real.yaml", "simulator", *more)
        said = answer.stderr.splitlines()[-1]
        assert answer.returncode != 0 and re.match(f"error: {expected}", said), said
    answer = place.call("judge", "real.yaml", "simulator", "--world", "robot.yaml", "--at-rest")
    assert answer.returncode == 2 and "cannot be used with" in answer.stderr
    assert set((place.folder / "results").rglob("*")) - before <= {place.folder / "results/.lock"}


def test_a_simulated_dataset_is_repeated_to_the_rounding_of_its_setpoints(place: Place) -> None:
    place.succeed("judge", "spec.yaml", "simulator", "--world", "robot.yaml", "--model", "again", "simulation.episodes=8",
                  "simulation.actuations_per_episode=4")
    rows = place.succeed("query", "select min(value) as r2 from metrics where model = 'again' and metric = 'r2'", "--format", "csv")
    assert float(rows.split()[-1]) > 0.999


def test_hidden_properties_are_fitted_and_the_fitted_world_predicts_the_test(place: Place) -> None:
    results = place.folder / "results"
    fit = fit_world("lab", place.folder / "stiffer.yaml", ["stiffness", "friction"], "tail", results=results)
    assert abs(fit.factors["stiffness"] - 0.25) < 0.05 * 0.25 and abs(fit.factors["friction"] - 0.4) < 0.05 * 0.4, fit
    assert fit.after < 0.02 < 0.3 < fit.before and fit.at_bounds == ()
    place.succeed("judge", "real.yaml", "simulator", "--world", "stiffer.yaml")
    factors = [word for name, value in fit.factors.items() for word in ("--factor", f"{name}={value}")]
    place.succeed("judge", "real.yaml", "simulator", "--world", "stiffer.yaml", *factors, "--model", "fitted")
    found = r2(place)
    assert found["fitted"] > 0.999 > found["persistence"] > found["simulator-stiffer"]
    # Another range does not contain the value.
    narrow = (place.folder / "stiffer.yaml").read_text().replace("stretch, scale_by: {log_uniform: [0.1, 10]}", "stretch, scale_by: {uniform: [0.5, 2]}")
    (place.folder / "narrow.yaml").write_text(narrow)
    fit = fit_world("lab", place.folder / "narrow.yaml", "stiffness", "tail", results=results)
    assert fit.at_bounds == ("stiffness",) and fit.factors["stiffness"] == pytest.approx(0.5)


def test_factors_and_outputs_that_are_not_there_are_named(place: Place) -> None:
    world, results = place.folder / "stiffer.yaml", place.folder / "results"
    for factors, output, dataset, message in [
        ("mass", "tail", "lab", "the world has no factor 'mass'; it has friction, stiffness"),
        ("stiffness", "tale", "lab", r"has no vector 'tale'; it has setpoint, place, tail"),
        ("stiffness", "tail", "nope", "has a name that begins with 'nope'"),
    ]:
        with pytest.raises((ValueError, RuntimeError), match=message):
            fit_world(dataset, world, factors, output, results=results)
    for factors, output, message in [([], "tail", "factors: .* found none"), ("stiffness", ["tail"] * 2, "found tail, tail")]:
        with pytest.raises(ValueError, match=message):
            fit_world("lab", world, factors, output, results=results)
    twice = place.call("judge", "real.yaml", "simulator", "--world", str(world), *["--factor", "stiffness=2"] * 2)
    assert twice.returncode != 0 and "name each once with --factor" in twice.stderr, twice.stderr
    for given, message in [
        ("mass=2", "the factor 'mass': the factors of the world stiffer are stiffness, friction"),
        ("stiffness=20", r"the factor 'stiffness': 20 is outside of its range \[0.1, 10\] in the world file"),
        ("stiffness", "write NAME=VALUE"),
    ]:
        answer = place.call("judge", "real.yaml", "simulator", "--world", str(world), "--factor", given)
        assert answer.returncode != 0 and re.search(message, answer.stderr), answer.stderr
