"""Files of models of other programs, which are attached to their predictions."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

__all__ = ["attachment", "load"]


@contextmanager
def attachment(network: Any) -> Iterator[Path | None]:
    """The file of a network: its path, or a temporary file with a program of PyTorch."""
    if network is None or isinstance(network, str | os.PathLike):
        yield None if network is None else Path(network)
        return
    with tempfile.TemporaryDirectory() as folder:
        yield _saved(network, Path(folder))


def _saved(network: Any, folder: Path) -> Path:
    """Writes a program of PyTorch to a file."""
    kind = type(network)
    if kind.__module__.startswith("torch."):
        import torch

        if isinstance(network, torch.jit.ScriptModule):
            torch.jit.save(network, folder / "network.pt")
            return folder / "network.pt"
        if isinstance(network, torch.export.ExportedProgram):
            torch.export.save(network, folder / "network.pt2")
            return folder / "network.pt2"
    raise TypeError(
        f"network: it is a {kind.__name__}, must be the path of a file, torch.export.export(module, arguments) or "
        "torch.jit.trace(module, arguments)"
    )


def load(path: Path) -> Any:
    """Loads an attached file.

    Returns:
        A `torch.nn.Module` on the CPU for TorchScript (.pt) and for a program of `torch.export` (.pt2); an
        `onnxruntime.InferenceSession` for ONNX (.onnx).

    Raises:
        ImportError: the package torch or onnxruntime is not installed.
        RuntimeError: the package can't load the file.
    """
    package = "onnxruntime" if path.suffix == ".onnx" else "torch"
    try:
        if package == "onnxruntime":
            import onnxruntime
        else:
            import torch
    except ImportError as error:
        raise ImportError(f"load_network needs {package} for {path}: pip install {package} ({error})") from error
    try:
        match path.suffix:
            case ".onnx":
                return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
            case ".pt":
                return torch.jit.load(path, map_location="cpu")
            case _:
                return torch.export.load(path).module()
    except Exception as error:
        raise RuntimeError(f"{package} can't load {path}: {' '.join(str(error).split())}") from error
