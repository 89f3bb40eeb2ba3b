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

import wpc


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
    """A file's columns by name, with an end at the last row."""
    try:
        with h5py.File(path) as file:
            widths = [file[name].shape[-1] for name in ("observations", "actions")]
    except Exception as error:  # of several types where a file is damaged
        sys.exit(f"{path} can't be read ({reason(error)})")
    columns = wpc.read_dataset(path, *widths, max_action=np.inf)
    if not len(columns["rewards"]):
        sys.exit(f"{path} has no rows")
    for name in ("terminals", "timeouts"):
        columns[name] = columns[name].astype(bool)
    columns["timeouts"][-1] |= ~columns["terminals"][-1]
    return columns


def describe(columns):
    return ", ".join(f"{name} ({x.shape[1]} wide)" for name, x in columns.items())


def check(paths, parts):
    """Exits with a sentence if the files don't belong together."""
    for (path, part), (other, columns) in itertools.combinations(
        zip(paths, parts, strict=True), 2
    ):
        if describe(part) != describe(columns):
            sys.exit(
                f"{path} has {describe(part)}, and {other} has {describe(columns)}: "
                "join files of one robot, all with next_observations or all without"
            )
        if all(np.array_equal(part[name], columns[name]) for name in part):
            sys.exit(f"{path} and {other} hold the same data: name them once")


def main(args):
    for path in args.files:
        if args.out.exists() and path.exists() and args.out.samefile(path):
            sys.exit(f"--out {args.out} is one of the files to join: name another")
    try_to_write(args.out)
    parts = [read(path) for path in args.files]
    check(args.files, parts)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    for name in ("rewards", "terminals", "timeouts"):
        joined[name] = joined[name].ravel()  # as D4RL's files have them
    write_or_exit(args.out, joined)
    terminals, timeouts = joined["terminals"], joined["timeouts"]
    transitions = np.count_nonzero((terminals | ~timeouts)[:-1])
    print(
        f"{args.out}: {transitions:,} transitions in "
        f"{np.count_nonzero(terminals | timeouts):,} episodes of {len(parts)} files"
    )


if __name__ == "__main__":
    try:
        main(tyro.cli(Args, description=__doc__))
    except wpc.UserError as error:
        sys.exit(str(error))
