"""Asks DuckDB what was asked of the harness, and says where the answers differ.

    compare_sql.py RESULTS ANSWERS

RESULTS is a results folder. ANSWERS holds `queries.json`, a list of {"about", "sql", "answer"} where `answer` is the
name of a Parquet file beside it with the harness's answer, and `runs.parquet`, the table that no file of RESULTS
holds. Prints JSON: a list of {"about", "sql", "difference"}.
"""

import json
import math
import re
import sys
from pathlib import Path

import duckdb

TABLES = ("epochs", "metrics", "predictions", "forces", "frames")


def same(ours: object, theirs: object) -> bool:
    """Whether two cells are the same; numbers to 1e-9 relative."""
    if ours is None or theirs is None or isinstance(ours, (str, bytes)) or isinstance(theirs, (str, bytes)):
        return ours == theirs
    if isinstance(ours, bool) != isinstance(theirs, bool):
        return False
    ours, theirs = float(ours), float(theirs)
    if math.isnan(ours) or math.isnan(theirs):
        return math.isnan(ours) and math.isnan(theirs)
    return math.isclose(ours, theirs, rel_tol=1e-9, abs_tol=1e-12)


def order(row: tuple) -> list:
    """Where a row comes among all rows, the same for numbers that differ in their last digits only."""
    def key(cell: object, digits: int) -> tuple:
        if cell is None:
            return (0, "")
        if isinstance(cell, (str, bytes)):
            return (1, cell if isinstance(cell, str) else cell.hex())
        return (2, f"{float(cell):.{digits}e}")

    # The further digits sort rows that are equal in the first ones.
    return [key(cell, digits) for digits in (6, 11) for cell in row]


def is_ordered(sql: str) -> bool:
    """Whether the answer itself has an order; one within brackets does not count."""
    while "(" in sql:
        shorter = re.sub(r"\([^()]*\)", "", sql)
        if shorter == sql:
            break
        sql = shorter
    return "order by" in sql.lower()


def difference(ours: list[tuple], theirs: list[tuple], ordered: bool) -> str | None:
    if len(ours) != len(theirs):
        return f"{len(ours)} rows, DuckDB has {len(theirs)}"
    if not ordered:
        ours, theirs = sorted(ours, key=order), sorted(theirs, key=order)
    for number, (mine, other) in enumerate(zip(ours, theirs)):
        if len(mine) != len(other) or not all(map(same, mine, other)):
            return f"row {number} is {mine}, DuckDB has {other}"
    return None


def main(results: Path, answers: Path) -> None:
    database = duckdb.connect()
    for table in TABLES:
        files = sorted(map(str, results.glob(f"runs/**/{table}.parquet")))
        reader = "read_parquet($files, hive_partitioning=false)"
        database.execute(f"create table {table} as select * from {reader}", {"files": files})
        # The harness computes with 64 bits.
        for name, kind in database.execute(f"select name, type from pragma_table_info('{table}')").fetchall():
            if kind == "FLOAT":
                database.execute(f'alter table {table} alter "{name}" type double')
    runs = str(answers / "runs.parquet")
    database.execute("create table runs as select * from read_parquet($runs)", {"runs": runs})
    found = []
    for query in json.loads((answers / "queries.json").read_text()):
        ours = duckdb.from_parquet(str(answers / query["answer"])).fetchall()
        theirs = database.execute(query["sql"]).fetchall()
        differs = difference(ours, theirs, is_ordered(query["sql"]))
        if differs is not None:
            found.append({"about": query["about"], "sql": query["sql"], "difference": differs[:500]})
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
