"""The command `harness export`, also as `python -m harness.export`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import harness
from harness.export import FORMATS, export

EXAMPLES = """examples:
  harness export --format lerobot results/datasets/empty-0123456789abcdef exported
  harness export --format rerun results/datasets/empty-0123456789abcdef recordings --episodes 0 7
  harness export --format onnx smoke/empty network.onnx
  harness export --format mlflow smoke sqlite:///mlflow.db
  harness export --format tensorboard smoke logs --condition "status = 'done' and seed = 0"
"""


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="harness export",
        description="Write a dataset (lerobot, rerun), a trained network (onnx),\n"
        "or the runs of an experiment (mlflow, tensorboard) for other programs.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--format", choices=[*FORMATS, "onnx", "mlflow", "tensorboard"], required=True)
    parser.add_argument("source", help="the dataset's folder in results/datasets, the run (onnx), or the experiment")
    parser.add_argument(
        "output", help="the new folder, the ONNX file, MLflow's tracking URI, or TensorBoard's log folder"
    )
    datasets = parser.add_argument_group("datasets")
    datasets.add_argument("--episodes", type=int, nargs="+", metavar="N", help="only these episodes [default: all]")
    networks = parser.add_argument_group("networks")
    networks.add_argument("--task", choices=["prediction", "reconstruction"], help="the network [default: prediction]")
    runs = parser.add_argument_group("runs")
    runs.add_argument("--results", metavar="DIR", help="folder of datasets and runs [default: results]")
    runs.add_argument("--condition", metavar="SQL", help="only runs that satisfy this condition over the table runs")
    runs.add_argument("--artifacts", action="store_true", help="also upload the files of each run (mlflow)")
    arguments = parser.parse_args(words)
    of_runs = {"--results": arguments.results, "--condition": arguments.condition, "--artifacts": arguments.artifacts}
    if arguments.format in FORMATS:
        misplaced = [option for option, value in of_runs.items() if value]
        misplaced += ["--task"] * bool(arguments.task)
    elif arguments.format == "onnx":
        others = {
            "--episodes": arguments.episodes,
            "--condition": arguments.condition,
            "--artifacts": arguments.artifacts,
        }
        misplaced = [option for option, value in others.items() if value]
    else:
        misplaced = ["--episodes"] * bool(arguments.episodes) + ["--task"] * bool(arguments.task)
        misplaced += ["--artifacts"] * (arguments.artifacts and arguments.format != "mlflow")
    if misplaced:
        parser.error(f"{misplaced[0]} can't be combined with --format {arguments.format}")
    try:
        print(_export(arguments))
    except KeyboardInterrupt:
        return 130
    except KeyError as error:
        print(f"error: {error.args[0]}", file=sys.stderr)
        return 1
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _export(arguments: argparse.Namespace) -> str:
    """Exports, and says what was done."""
    if arguments.format in FORMATS:
        return str(export(arguments.source, arguments.format, arguments.output, arguments.episodes))
    results, condition = arguments.results or "results", arguments.condition
    if arguments.format == "onnx":
        harness.export_onnx(arguments.source, arguments.output, arguments.task or "prediction", results)
        return str(arguments.output)
    if arguments.format == "mlflow":
        done = harness.export_mlflow(
            arguments.source,
            tracking_uri=arguments.output,
            condition=condition,
            artifacts=arguments.artifacts,
            results=results,
        )
    else:
        folder = Path(arguments.output)
        done = harness.export_tensorboard(arguments.source, folder=folder, condition=condition, results=results)
    return f"{done.exported} runs exported to {arguments.output}, {done.skipped} were there before"


if __name__ == "__main__":
    sys.exit(main())
