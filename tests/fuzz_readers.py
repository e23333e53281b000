"""Every reader, and the stream, against many damaged inputs: python tests/fuzz_readers.py --inputs 100000

What a reader neither reads nor refuses with an `InputError` is printed, its input is kept in --keep, and the exit code
is 1. A crash of the interpreter is found as well: each reader is tried in a process of its own.
"""

from __future__ import annotations

import argparse
import logging
import multiprocessing
import random
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "data_tools"))
from damage import damaged, targets

from saga_fg import InputError


def fuzz(name: str, inputs: int, seed: int, keep: Path) -> int:
    """Number of faults of one reader."""
    warnings.simplefilter("error")
    logging.disable()
    faults = refused = 0
    with tempfile.TemporaryDirectory() as folder:
        target = targets(Path(folder))[name]
        originals = {path: path.read_bytes() for path in target.files}
        rng = random.Random(f"{seed} {name}")
        start = time.perf_counter()
        for number in range(inputs):
            path = rng.choice(target.files)
            content = damaged(originals[path], rng)
            keep_as = keep / f"{name.replace(' ', '_').replace(',', '')}-{seed}-{number}{path.suffix}"
            keep_as.write_bytes(content)  # before it is read: the reader may take the interpreter with it
            path.write_bytes(content)
            try:
                target.read()
            except InputError:
                refused += 1
            except Exception:
                faults += 1
                print(f"{name}: {keep_as}:\n{traceback.format_exc(limit=-2)}", flush=True)
                path.write_bytes(originals[path])
                continue
            keep_as.unlink()
            path.write_bytes(originals[path])
        rate = inputs / (time.perf_counter() - start)
    print(f"{name}: {inputs} inputs, {refused} refused, {faults} faults, {rate:.0f} a second", flush=True)
    return faults


def main() -> int:
    """Exit code 0 if every reader stood it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=100_000, help="for each reader")
    parser.add_argument("--only", help="a part of the readers' names")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-faults"), help="folder for inputs that are faults")
    options = parser.parse_args()
    options.keep.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        names = [name for name in targets(Path(folder)) if not options.only or options.only in name]
    context = multiprocessing.get_context("spawn")
    bad = []
    for name in names:
        process = context.Process(target=_child, args=(name, options.inputs, options.seed, options.keep))
        process.start()
        process.join()
        if process.exitcode:
            bad.append(f"{name} (exit code {process.exitcode})")
    print(f"faults in: {', '.join(bad)}" if bad else "every reader stood it")
    return 1 if bad else 0


def _child(name: str, inputs: int, seed: int, keep: Path) -> None:
    sys.exit(1 if fuzz(name, inputs, seed, keep) else 0)


if __name__ == "__main__":
    sys.exit(main())
