"""Odd variants of files: each is imported right, or ends in one message with the file, the row and what to do."""

import gzip
import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from harness.importing import import_dataset

ROWS = "0,0\n0.1,1\n0.2,2\n"
GOOD = f"t,x\n{ROWS}"
PARQUET = {"format": "parquet", "episode": "e", "order": "t", "max_gap_s": None, "streams": None}
ARRAYS = {"format": "numpy", "streams": {"log": {"data": "/", "time": "t"}}, "source": "rec/a.npz"}


def text(content: str | bytes, name: str = "a.csv"):
    def write(folder: Path) -> None:
        data = content if isinstance(content, bytes) else content.encode()
        (folder / name).write_bytes(data)

    return write


def rows(**columns):
    return lambda folder: pl.DataFrame(columns).write_parquet(folder / "a.parquet")


def arrays(**columns):
    return lambda folder: np.savez(folder / "a.npz", **columns)


def log(**keys) -> dict:
    return {"streams": {"log": {"file": "*.csv", "time": "t"} | keys}}


def x(term: str) -> dict:
    return {"modalities": {"setpoint": "none", "x": term}}


GIVEN = [0, 1, 2]
RATE = {"streams": {"log": {"file": "*.csv", "rate_hz": 10}}}
VARIANTS = {
    # what is imported
    "a mark of UTF-8": (text(b"\xef\xbb\xbf" + GOOD.encode()), {}, GIVEN),
    "lines that end in CR LF": (text(GOOD.replace("\n", "\r\n")), {}, GIVEN),
    "no line break at the end": (text(GOOD.rstrip()), {}, GIVEN),
    "semicolons and decimal commas": (text("t;x\n0,0;0,5\n0,1;1,5\n"), {}, [0.5, 1.5]),
    "tabs": (text(GOOD.replace(",", "\t")), {}, GIVEN),
    "spaces around values": (text("t , x\n 0 , 0\n 0.1 , 1 \n0.2,  2\n"), {}, GIVEN),
    "columns of several spaces": (text("t    x\n  0    0\n0.1    1\n0.2    2\n"), {}, GIVEN),
    "a comma at the end of all lines": (text("t,x,\n0,0,\n0.1,1,\n0.2,2,\n"), {}, GIVEN),
    "quoted values": (text('"t","x"\n"0","0"\n"0.1","1"\n"0.2","2"\n'), {}, GIVEN),
    "a quoted comma": (text('t,x,note\n0,0,"a, b"\n0.1,1,\n0.2,2,\n'), {}, GIVEN),
    "blank lines around the header": (text(f"\n{GOOD}".replace("x\n", "x\n\n\n")), {}, GIVEN),
    "comments above the header": (text(f"# by me, 3\n#\n{GOOD}"), {}, GIVEN),
    "a dot in a name": (text(GOOD.replace("x", "a.b")), x("log.a.b"), GIVEN),
    "a name beyond ASCII": (text(GOOD.replace("x", "größe")), x("log.größe"), GIVEN),
    "a unit in the header": (text(GOOD.replace("x", "Force [N]")), x("log.Force [N]"), GIVEN),
    "exponents and signs": (text("t,x\n0,0e0\n1e-1,+1\n.2,2.\n"), {}, GIVEN),
    "negative times": (text("t,x\n-0.2,0\n-0.1,1\n0,2\n"), {}, GIVEN),
    "times since 1970": (text("t,x\n1700000000.0,0\n1700000000.1,1\n1700000000.2,2\n"), {}, GIVEN),
    "the same time twice": (text("t,x\n0,7\n0,0\n0.1,1\n0.2,2\n"), {}, GIVEN),
    "ISO dates of a zone": (text("t,x\n2024-01-01T00:00:00+01:00,0\n2024-01-01T00:00:00.1+01:00,1\n"), {}, [0, 1]),
    "times in us": (text("t,x\n0,0\n100000,1\n200000,2\n"), log(time_unit="us"), GIVEN),
    "no times but a rate": (text("x\n0\n1\n2\n"), RATE, GIVEN),
    "a pattern that the times match": (text(GOOD), x("log.*"), GIVEN),
    "a file in brackets": (text(GOOD, "a [1].csv"), {}, GIVEN),
    "a value that holds long": (text("t,x\n0,0\n60,1\n"), log(max_gap_s="unlimited") | {"sample_rate_hz": 0.05}, [0, 0, 0, 1]),
    "200 columns": (text(f"t,x,{','.join(f'c{i}' for i in range(198))}\n0,0{',9' * 198}\n0.1,1{',9' * 198}\n"), {}, [0, 1]),
    "arrays of objects beside": (arrays(t=np.arange(3) / 10, x=np.arange(3), o=np.array([{}])), ARRAYS, GIVEN),
    "a Parquet file in brackets": (
        lambda folder: pl.DataFrame({"e": [1] * 3, "t": [0, 1, 2], "x": GIVEN}).write_parquet(folder / "d[1].parquet"),
        PARQUET | {"source": "rec/d[1].parquet"} | x("x"),
        GIVEN,
    ),
    # what is refused
    "NA": (text("t,x\n0,0\n0.1,NA\n"), {}, "a.csv: line 3: 'x' is 'NA', which is no number; .* 'missing_values'"),
    "an empty value": (text("t,x\n0,0\n0.1,\n0.2,2\n"), {}, "a.csv: line 3: 'log.x' is nan; .* say 'missing: skip'"),
    "an empty stamp": (text("t,x\n0,0\n,1\n0.2,2\n"), {}, "a.csv: line 3: nan is no time; .* say 'missing: skip'"),
    "a row that ends early": (text("t,x\n0,0\n0.1\n0.2,2\n"), {}, "a.csv: line 3: 'log.x' is nan; "),
    "a row that is too long": (text("t,x\n0,0\n0.1,1,9\n"), {}, "a.csv: line 3: has 3 values, and the header 2"),
    "infinity": (text("t,x\n0,0\n0.1,inf\n"), {}, "a.csv: line 3: 'log.x' is inf; it must be a finite number"),
    "a hexadecimal number": (text("t,x\n0,0\n0.1,0x1F\n"), {}, "a.csv: line 3: 'x' is '0x1F', which is no number"),
    "thousands": (text('t,x\n0,0\n0.1,"1,000"\n'), {}, "a.csv: line 3: 'x' is '1,000', which is no number"),
    "percent": (text("t,x\n0,0\n0.1,5%\n"), {}, "a.csv: line 3: 'x' is '5%', which is no number"),
    "a column of texts": (text("t,x\n0,a\n0.1,b\n"), {}, "a.csv: line 2: 'x' is 'a', which is no number"),
    "a unit in the times": (text("t,x\n0.0 s,0\n0.1 s,1\n"), {}, "a.csv: line 2: 't' is '0.0 s', which is no time"),
    "a row of units": (text(f"t,x\ns,N\n{ROWS}"), {}, "a.csv: line 2: 't' is 's', .* say 'units_row: true'"),
    "a line at the end": (text(f"{GOOD}end\n"), {}, "a.csv: line 5: 't' is 'end', which is no "),
    "a comment between rows": (text("t,x\n0,0\n# pause\n0.1,1\n"), {}, "a.csv: line 3: 't' is '# pause', which is no "),
    "a time that goes back": (text("t,x\n0,0\n0.2,1\n0.1,2\n"), {}, "a.csv: line 4: the time goes back .* 'steps_back: sort'"),
    "a gap": (text("t,x\n0,0\n5,1\n5.1,1\n"), {}, "a.csv: line 2: 5 s pass until .* say 'gaps: split'"),
    "times in ms": (text("t,x\n0,0\n100,1\n200,2\n"), {}, "a.csv: line 2: 100 s pass until the next row"),
    "one row": (text("t,x\n0,0\n"), {}, "a.csv, from 0 s: episode 0: it has 1 sample; it must have 2 or more"),
    "no rows": (text("t,x\n"), {}, "a.csv: line 2: there are no rows below the header"),
    "nothing": (text(""), {}, "a.csv: line 1: the file ends before a header with the names of the columns"),
    "only a comment": (text("# a\n"), {}, "a.csv: line 2: the file ends before a header"),
    "a column twice": (text(f"t,x,x\n{ROWS.replace(chr(10), ',1' + chr(10))}"), {}, "a.csv: line 1: the column 'x' is there twice"),
    "no header": (text(ROWS), {"streams": {"log": {"file": "*.csv", "time": "0"}}}, "a.csv: .*line 1: the column '0' is there twice"),
    "no header, and other names": (text("0,7,1\n0.1,8,2\n"), {}, "a.csv: there is no column 't'; .* say 'header: none'"),
    "a header below the end": (text(GOOD), log(header=99), "a.csv: line 5: the file ends before a header"),
    "bytes 0": (text(b"t,x\0\n0,0\n"), {}, "a.csv: line 1: is no text: it contains a byte 0"),
    "UTF-16": (text(GOOD.encode("utf-16")), {}, "a.csv: line 1: is no text in UTF-8; name its encoding"),
    "Latin-1": (text("t,x,°\n0,0,1\n".encode("latin-1")), {}, "a.csv: line 1: is no text in UTF-8; name its encoding"),
    "an unknown encoding": (text(GOOD), log(encoding="utf-9"), "encoding: Python knows no 'utf-9'; usual ones are utf-8"),
    "lines that end in CR": (text(GOOD.replace("\n", "\r")), {}, "a.csv: line 1: the lines end in CR alone; save the file"),
    "an open quotation mark": (text('t,x\n0,0\n0.1,"1\n0.2,2\n'), {}, "a.csv: line 3: a quotation mark is not closed"),
    "a damaged gzip": (text(gzip.compress(GOOD.encode())[:-12], "a.csv.gz"), log(file="*.csv.gz"), "a.csv.gz: "),
    "a damaged Parquet file": (text(b"PAR1", "a.parquet"), PARQUET | {"source": "rec/a.parquet"} | x("x"), "a.parquet"),
    "no file": (lambda folder: None, {}, "source: .*rec holds no \\*.csv"),
    "an infinite gap": (text(GOOD), {"max_gap_s": float("inf")}, "lab.yaml:1:.*: 'max_gap_s': "),
    "rows of Parquet with a gap": (rows(e=[1] * 5, t=[0, 1, 2, 3, 9], x=[0] * 5), PARQUET | x("x"), "a.parquet: row 4: .* none may be missing"),
    "rows of Parquet of another rate": (rows(e=[1] * 3, t=[0.0, 0.5, 1.0], x=GIVEN), PARQUET | x("x"), "'t' grows by 0.5 .* write the rate"),
    "objects as values": (arrays(t=np.arange(3) / 10, x=np.array([{}, 1, 2])), ARRAYS, "a.npz: .*there is no column 'log.x'|there is no"),
    "arrays of other lengths": (arrays(t=np.arange(3) / 10, x=np.arange(4)), ARRAYS, "a.npz: x: has 4 rows, and its times t have 3"),
    "a damaged npz": (text(b"PK", "a.npz"), ARRAYS, "a.npz: can't be read"),
}  # fmt: skip


@pytest.mark.parametrize("variant", VARIANTS)
def test_an_odd_file_is_imported_right_or_ends_in_one_message(tmp_path, variant):
    write, keys, expected = VARIANTS[variant]
    (tmp_path / "rec").mkdir()
    write(tmp_path / "rec")
    mapping = (
        {"name": "lab", "source": "rec", "format": "csv", "sample_rate_hz": 10, "max_gap_s": 0.5} | log() | x("log.x")
    )
    mapping = {key: value for key, value in (mapping | keys).items() if value is not None}
    (tmp_path / "lab.yaml").write_text(json.dumps(mapping).replace("Infinity", ".inf"))
    results = tmp_path / "results"
    if isinstance(expected, list):
        name = import_dataset(tmp_path / "lab.yaml", results, progress=False)
        episodes = pl.read_parquet(results / f"datasets/{name}/episode_*.parquet")
        assert episodes.select(pl.col("^x_.*$")).to_series().to_list() == expected
        return
    with pytest.raises((ValueError, OSError), match=expected) as error:
        import_dataset(tmp_path / "lab.yaml", results, progress=False)
    assert len(str(error.value).splitlines()) == 1 and "Error" not in str(error.value)
    assert not results.exists() and sorted(path.name for path in tmp_path.iterdir()) == ["lab.yaml", "rec"]
