"""Datasets in PyTorch."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SMOKE, check_example

import harness

torch = pytest.importorskip("torch", reason="`make interchange` tests with torch")

from harness.torch import Transitions  # noqa: E402


def test_transitions_are_a_map_style_dataset(folders: dict[str, Path]) -> None:
    data = harness.Dataset(folders["empty"])
    transitions = data.torch(["proprioception", "vision"], ["contact_force", "frame_difference"])
    assert len(transitions) == 4 * 29
    observation, action, following = transitions[29]  # the second episode's first
    assert torch.equal(observation["proprioception"], torch.tensor(np.array(data["proprioception"][30])))
    assert np.array_equal(observation["vision"].numpy().transpose(1, 2, 0), data["vision"][30])
    assert np.array_equal(action.numpy(), data["setpoint"][31] - data["setpoint"][30])
    assert np.array_equal(following["contact_force"].numpy(), data["contact_force"][31])
    change = (data["vision"][31].astype(np.float32) - data["vision"][30].astype(np.float32)) / np.float32(255)
    assert np.array_equal(following["frame_difference"].numpy().transpose(1, 2, 0), change)
    loader = torch.utils.data.DataLoader(transitions, batch_size=16, num_workers=2, shuffle=True)
    assert sum(len(actions) for _, actions, _ in loader) == len(transitions)


def test_a_spawned_process_reads_the_dataset_itself(folders: dict[str, Path]) -> None:
    data = harness.Dataset(folders["empty"])
    transitions = data.torch(["vision"], ["frame_difference"], "target", data.split("training"))
    pickled = pickle.dumps(transitions)
    assert len(pickled) < 10_000, "it would take 12 kB per sample with the frames"
    again = pickle.loads(pickled)
    assert (again.input, again.output, again.action) == (("vision",), ("frame_difference",), "target")
    assert np.array_equal(again.samples, transitions.samples)
    loader = torch.utils.data.DataLoader(transitions, num_workers=1, multiprocessing_context="spawn")
    for index, (observation, action, following) in enumerate(loader):
        expected = transitions[index]
        assert torch.equal(observation["vision"][0], expected[0]["vision"])
        assert torch.equal(action[0], expected[1])
        assert torch.equal(following["frame_difference"][0], expected[2]["frame_difference"])


def test_only_the_change_of_an_image_is_computed() -> None:
    """A vector may have a name that ends like that of an image's change."""
    values = np.arange(6, dtype=np.float32).reshape(3, 2)
    frames = np.arange(3 * 4 * 4 * 3, dtype=np.uint8).reshape(3, 4, 4, 3)

    class Recorded(dict[str, Any]):
        bounds = np.array([[0, 3]])

    data = Recorded(torque_difference=values, torque=values + 1, wrist=frames, setpoint=values)
    transitions = Transitions(data, ["torque_difference"], ["wrist_difference", "wrist"])
    observation, _, following = transitions[1]
    assert np.array_equal(observation["torque_difference"].numpy(), values[1])
    assert np.array_equal(following["wrist"].numpy(), frames[2].transpose(2, 0, 1))
    change = (frames[2].astype(np.float32) - frames[1].astype(np.float32)) / np.float32(255)
    assert np.array_equal(following["wrist_difference"].numpy(), change.transpose(2, 0, 1))
    with pytest.raises(KeyError, match="setpoint_difference"):
        Transitions(data, ["setpoint_difference"], ["wrist"])


def test_windows_of_a_task_are_a_map_style_dataset(results: Path) -> None:
    overrides = {"input": ["proprioception", "vision"], "output": ["contact_force"], "window.context": 3}
    task = harness.task(SMOKE, overrides, cell="empty", results=results)
    windows, found = task.train(), task.torch("train")
    context, actions, targets = found[30]
    expected = windows[30]
    assert np.array_equal(context["proprioception"].numpy(), expected.context["proprioception"])
    assert np.array_equal(context["vision"].numpy().transpose(0, 2, 3, 1), expected.context["vision"])
    assert np.array_equal(context["action"].numpy(), expected.context["action"])
    assert np.array_equal(actions.numpy(), expected.actions)
    assert np.array_equal(targets["contact_force"].numpy(), expected.targets["contact_force"])
    loader = torch.utils.data.DataLoader(found, batch_size=16, shuffle=True)
    assert sum(len(actions) for _, actions, _ in loader) == len(windows)


@pytest.mark.parametrize("example", ["torch_cnn", "torch_gru", "torch_transformer"])
def test_the_examples_for_pytorch_work(example: str, copy: Path) -> None:
    check_example(example, ["proprioception", "arm", "vision"], copy)
