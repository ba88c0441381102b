"""Record files with bytes changed, lost and added are read or refused in one line, never raw."""

from __future__ import annotations

import io
import warnings

import h5py
import numpy as np
import pandas as pd
import pytest

import fkgen
from fkgen.errors import DataError
from fkgen.study.records.reading import checked
from fkgen.study.records.table import read_table
from fkgen.study.reports.first_spec import first_spec

ONE = [[1.0, 0.0], [0.0, 1.0]]
MODEL = {"A": [[1.0, "dt"], [0.0, 1.0]], "C": ONE, "Q": ONE, "R": ONE, "x0": [0.0, 0.0], "P0": ONE}
MODEL |= {"outputs": [{"name": "gps"}, {"name": "speed"}], "sample_time": "dt"}
SPEC = fkgen.Spec.from_dict(
    {"name": "w", "parameters": {"dt": 0.1}, "model": MODEL, "filter": {"family": "kf"}}
)
FRAME = pd.DataFrame(
    {"t": np.arange(6) / 10, "gps": np.arange(6) / 7, "speed": [1, 2, None, 3, 4, 5]}
)
MARKS = [*(b"\n", b"\r", b",", b";", b'"', b"\t", b" ", b"nan", b"-", b"1e999", b"\0", b"\xff")]
MARKS += [*(b"\xef\xbb\xbf", b"[ms]", b"inf", b"1_0", b"9" * 20, b"#", b"T", b":", b"\xe2\x80\xa8")]
OPTIONS = [{}] * 8 + [{"missing": ("-",)}, {"time": ""}, {"delimiter": ";"}, {"decimal": ","}]
OPTIONS += [{"encoding": "utf-16"}, {"skip_rows": 1}, {"columns": ("gps=2",)}, {"time": "gps"}]


def in_memory(write):
    out = io.BytesIO()
    write(out)
    return out.getvalue()


def hdf(out):
    with h5py.File(out, "w") as file:
        for name, values in FRAME.items():
            file[name] = values


COMMAS = FRAME.to_csv(index=False, sep=";", decimal=",")
FILES = {
    "plain.csv": FRAME.to_csv(index=False).encode(),
    "wide.csv": COMMAS.encode("utf-16"),
    "stated.csv": f"sep=;\nLogger\n{COMMAS}".encode(),
    "dated.csv": b"t,gps,speed\n2024-05-01T12:00:00,1,2\n2024-05-01T12:00:01,3,4\n",
    "a.parquet": in_memory(FRAME.to_parquet),
    "a.npz": in_memory(lambda out: np.savez(out, **{n: FRAME[n].to_numpy() for n in FRAME})),
    "a.mat": in_memory(hdf),
}


def broken(rng, data):
    data = bytearray(data)
    for _ in range(rng.integers(1, 6)):
        at = int(rng.integers(len(data) + 1))
        kind = rng.integers(4)
        if kind == 0:
            data[at : at + 1] = rng.bytes(1)
        elif kind == 1:
            data[at:at] = MARKS[rng.integers(len(MARKS))]
        elif kind == 2 or rng.random() < 0.8:
            del data[at : at + int(rng.integers(1, 6))]
        else:
            del data[at:]
    return bytes(data)


@pytest.mark.parametrize("name", FILES)
def test_a_broken_file_is_read_or_refused_in_one_line(tmp_path, name):
    rng, refused = np.random.default_rng(len(name)), list[str]()
    path = tmp_path / name
    for _ in range(150):
        path.write_bytes(broken(rng, FILES[name]))
        options = OPTIONS[rng.integers(len(OPTIONS))]
        for read in (lambda reading: read_table(reading, SPEC), first_spec):
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                try:
                    read(checked(path, **options))
                except DataError as error:
                    refused.append(str(error))
    assert 10 < len(refused) < 300
    assert not [line for line in refused if "\n" in line or "; expected " not in line]


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("sep=é\nt;gps;speed\n0,0;0,1;0,2\n", {}, None),
        ('sep="\nt;gps;speed\n0,0;0,1;0,2\n', {}, None),
        ("t,gps,speed\n0,1,2\n", {"encoding": "utf-16"}, "a file that is not in utf-16"),
        ("t,gps,speed\n0,1,1e308\n1,-1e308,1e308\n", {}, None),
    ],
)
def test_what_was_found_by_breaking_files(tmp_path, text, options, message):
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    if message is None:
        assert first_spec(checked(path, **options))
        assert read_table(checked(path, **options), SPEC).y.size
        return
    for read in (first_spec, lambda reading: read_table(reading, SPEC)):
        with pytest.raises(DataError, match=message):
            read(checked(path, **options))


def test_a_delimiter_is_plain():
    with pytest.raises(DataError, match="--delimiter: given 'é'; expected one character"):
        checked("a.csv", delimiter="é")
