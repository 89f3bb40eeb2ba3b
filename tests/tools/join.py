# SPDX-License-Identifier: MIT
"""Joins HDF5 files in D4RL's format into one, in the order in which they are named.

    python tests/tools/join.py hopper_medium.hdf5 hopper_expert.hdf5 \\
        --out hopper_medium_expert.hdf5

D4RL's medium-expert data are made so. The last row of each file ends its episode, with
a timeout if it is not terminal, so no transition begins in one file and ends in
another. What the scripts don't read, such as D4RL's infos and metadata, is left out.
"""

import itertools
import sys
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import tyro

sys.path.insert(0, str(Path(__file__).parents[2]))
from make_dataset import reason, try_to_write, write_or_exit

NEEDED = ("observations", "actions", "rewards", "terminals", "timeouts")
FLAGS = ("terminals", "timeouts")


@dataclass
class Args:
    files: tyro.conf.Positional[list[Path]]
    """the HDF5 files to join"""
    out: Path
    """the HDF5 file to write"""

    def __post_init__(self):
        if not self.files:
            raise ValueError("name at least one file to join")


def read(path):
    """A file's columns by name, with an end at the last row, and the unread names.

    Exits with a sentence if the file is not in D4RL's format.
    """
    columns = {}
    try:
        with h5py.File(path) as file:
            names = set(file)
            for name in (*NEEDED, "next_observations"):
                if name in names:
                    columns[name] = np.float32(file[name][:])
    except Exception as error:  # of several types where a file is damaged
        sys.exit(f"{path} can't be read ({reason(error)})")
    if missing := [name for name in NEEDED if name not in columns]:
        sys.exit(f"{path} has no {', '.join(missing)}, which D4RL's format needs")

    rows = len(columns["observations"])
    for name, column in columns.items():
        width = column.size // max(rows, 1)
        is_flat = name in ("rewards", *FLAGS)
        if not rows or column.size != rows * width or (is_flat and width != 1):
            sys.exit(
                f"{path}: {name} has shape {column.shape}, where observations has "
                f"{rows:,} rows; each column needs as many, and at least one"
            )
        columns[name] = column.reshape(rows) if is_flat else column.reshape(rows, width)
    for name in FLAGS:
        if not np.isin(columns[name], (0, 1)).all():
            sys.exit(f"{path}: {name} must be 0 or 1 in each row")
        columns[name] = columns[name].astype(bool)
    columns["timeouts"][-1] |= not columns["terminals"][-1]
    return columns, names - columns.keys()


def check(paths, parts):
    """Exits with a sentence if the files don't belong together."""
    for (path, part), (other, columns) in itertools.combinations(
        zip(paths, parts, strict=True), 2
    ):
        if part.keys() != columns.keys():
            with_key, without = path, other
            if "next_observations" in columns:
                with_key, without = other, path
            sys.exit(
                f"{with_key} has next_observations and {without} has none: make a copy "
                "of the former without them, or add them to the latter"
            )
        for name in part:
            if part[name].shape[1:] != columns[name].shape[1:]:
                sys.exit(
                    f"{name} are {part[name].shape[1]} numbers wide in {path} and "
                    f"{columns[name].shape[1]} in {other}: join files of one robot"
                )
        if all(np.array_equal(part[name], columns[name]) for name in part):
            sys.exit(f"{path} and {other} hold the same data: name them once")


def main(args):
    for path in args.files:
        if args.out.exists() and path.exists() and args.out.samefile(path):
            sys.exit(f"--out {args.out} is one of the files to join: name another")
    try_to_write(args.out)
    parts, left_out = zip(*map(read, args.files), strict=True)
    check(args.files, parts)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    write_or_exit(args.out, joined)
    if names := set.union(*left_out):
        print(f"left out, as the scripts don't read them: {', '.join(sorted(names))}")
    terminals, timeouts = joined["terminals"], joined["timeouts"]
    transitions = np.count_nonzero((terminals | ~timeouts)[:-1])
    print(
        f"{args.out}: {transitions:,} transitions in "
        f"{np.count_nonzero(terminals | timeouts):,} episodes of {len(parts)} files"
    )


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
