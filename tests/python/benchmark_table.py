"""Lets the benchmarks' driver compare invented contenders, prints its table, and then the Parquet file as read back.

python benchmark_table.py FILE
"""

import itertools
import json
import sys
from pathlib import Path

import pyarrow.parquet

sys.path.append(str(Path(__file__).parents[2] / "harness" / "benches"))
import compare  # noqa: E402
import report  # noqa: E402


def contender(name, values, target=None):
    turns = itertools.cycle(values)
    return compare.Contender(name, lambda: next(turns), target)


def main() -> None:
    path = Path(sys.argv[1])
    comparisons = (
        compare.Comparison(
            "a step", "s", (contender("harness", (0.2, 9, 0.1)), contender("peer", (0.5, 0.4, 1), 2))
        ),
        compare.Comparison(
            "a rate", "1/s", (contender("harness", (500, 1, 600)), contender("peer", (200, 100, 300)))
        ),
    )
    measurements = [row for comparison in comparisons for row in compare.compare(comparison, rounds=3)]
    versions = {name: "0" for name, kind, _, _ in report.COLUMNS if kind == "text"}
    machine = report.Machine(
        **{name: versions.get(name, 1) for name in report.Machine.__dataclass_fields__} | {"git_dirty": False}
    )
    print(report.markdown(measurements, machine))
    report.write_parquet(path, measurements, machine)
    table = pyarrow.parquet.read_table(path)
    units = {field.name: field.metadata[b"unit"].decode() for field in table.schema}
    columns = json.loads(table.schema.metadata[b"harness.columns"])
    print(json.dumps({"ratio": table["ratio"].to_pylist(), "units": units, "columns": columns}))


if __name__ == "__main__":
    main()
