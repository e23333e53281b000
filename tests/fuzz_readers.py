"""Every reader, and the stream, against many damaged inputs: python tests/fuzz_readers.py --inputs 50000

The inputs come in parts of 1000, each drawn from (seed, reader, part) alone. They are read in another process, which
ends after some parts, so that a crash of the interpreter is found as well. All readers have their first parts before
any has its next. What was done is kept in `--state`, in `seed-N.json`; a run that was stopped goes on where it was when
it is started again.

An input that a reader neither reads nor refuses with an `InputError` is kept in `--state` and printed. The exit code is
1 if there are any, those of earlier runs with this state included.
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import random
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # the folders beside this script are named as the packages are
from data_tools.files.file_access import write_text
from saga_fg import InputError
from tests.data_tools.damage import Target, another, targets

PART = 1000  # inputs
ROUNDS = (1, 8, 64)  # parts that all readers have before any has more; later rounds end at multiples of the last one
HANGS = 600.0  # s for one input


def main() -> int:
    """Do the parts that are missing; exit code 0 if every reader stood all inputs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=50_000, help="for each reader, in whole parts of 1000")
    parser.add_argument("--only", default="", help="a part of the readers' names")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--state", type=Path, default=Path("fuzz-state"), help="folder: counts, inputs that are faults")
    options = parser.parse_args()
    options.state.mkdir(exist_ok=True)
    kept = options.state / f"seed-{options.seed}.json"
    counts: dict[str, dict[str, int]] = json.loads(kept.read_text()) if kept.exists() else {}
    with tempfile.TemporaryDirectory() as folder:
        names = [name for name in targets(Path(folder)) if options.only in name]
    parts = -(-options.inputs // PART)
    for end in (*(each for each in ROUNDS if each < parts), *range(ROUNDS[-1] * 2, parts, ROUNDS[-1]), parts):
        for name in names:
            count = counts.setdefault(name, {"inputs": 0, "refused": 0, "faults": 0})
            while (first := count["inputs"] // PART) < end:
                for refused, faults in parts_of(name, options.seed, range(first, end), options.state):
                    count["inputs"] += PART
                    count["refused"] += refused
                    count["faults"] += faults
                    write_text(kept, json.dumps(counts, indent=1) + "\n")
                print(f"{name}: {', '.join(f'{n} {what}' for what, n in count.items())}", flush=True)
    bad = [name for name in names if counts.get(name, {}).get("faults")]
    print(f"faults in: {', '.join(bad)}" if bad else "every reader stood it")
    return 1 if bad else 0


def parts_of(name: str, seed: int, parts: range, state: Path) -> Iterator[tuple[int, int]]:
    """Count the refused inputs of each part, and the faults; a crash or hang is a fault, and ends the parts."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_child, args=(name, seed, parts, state, there.send))
    process.start()
    there.close()
    refused = faults = part = 0
    with suppress(EOFError):
        while here.poll(HANGS):
            number, refused, faults = here.recv()
            if number == PART:
                yield refused, faults
                refused, faults, part = 0, 0, part + 1
        process.kill()
    process.join()
    if process.exitcode:
        print(f"{name}: part {parts[part]} of seed {seed}: exit code {process.exitcode}, see {state}", flush=True)
        yield refused, faults + 1


def _child(name: str, seed: int, parts: range, state: Path, tell: Callable[[tuple[int, int, int]], None]) -> None:
    warnings.simplefilter("error")
    logging.disable()
    with tempfile.TemporaryDirectory() as folder:
        target = targets(Path(folder))[name]
        for part in parts:
            fuzz(name, target, seed, part, state, tell)


def fuzz(
    name: str, target: Target, seed: int, part: int, state: Path, tell: Callable[[tuple[int, int, int]], None]
) -> None:
    """Read the inputs of one part; `tell` is called with how many were read, were refused, and are faults so far."""
    originals = {path: path.read_bytes() for path in target.files}
    rng = random.Random(f"{seed} {name} {part}")
    refused = faults = 0
    for done in range(1, PART + 1):
        path = rng.choice(target.files)
        content = another(path, originals[path], rng)
        kept = state / f"{name.replace(' ', '_').replace(',', '')}-{seed}-{part * PART + done - 1}{path.suffix}"
        kept.write_bytes(content)  # before it is read: the reader may take the interpreter with it
        path.write_bytes(content)
        fault = False
        try:
            target.read()
        except InputError:
            refused += 1
        except Exception:
            fault = True
            faults += 1
            print(f"{name}: {kept}:\n{traceback.format_exc(limit=-2)}", flush=True)
        if not fault:
            kept.unlink()
        path.write_bytes(originals[path])
        tell((done, refused, faults))


if __name__ == "__main__":
    sys.exit(main())
