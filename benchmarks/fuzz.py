"""Does anything break on random scenes and damaged files?

Kinds of scenes (dimension, obstacles, scheme, solvers, precision) are drawn in turn, and values of
each kind at random: `tests/support/fuzz.py`. Every case must solve its contact problems, balance
its energy, have the gradient that differences show, and be the same in a batch, in a program of
its own and as a user calls it: `tests/support/fuzz_checks.py`. Readers must end damaged files with
a result or a named error: `tests/support/damage.py`.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path

# Batched LAPACK calls of one program can wait for each other for ever in the thread pool of XLA.
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
sys.path.append(str(Path(__file__).parents[1] / "tests"))

import jax
import matplotlib
import numpy as np
from common import measure
from support import damage, fuzz, fuzz_checks

#: Cases of a batch that are run as a user calls them; that takes longer than all others together.
PLAIN = 5


def fuzz_kind(number: int, seeds: range) -> tuple[fuzz.Kind, fuzz_checks.Report]:
    """Return the kind of a number and what was found in its cases."""
    kind, report = fuzz.draw_kind(number), fuzz_checks.Report()
    batch = fuzz.run(kind, seeds)
    fuzz_checks.judge(batch, report)
    for k in range(len(seeds)):
        fuzz_checks.judge_repeat(batch, k, batch.single, "single", report)
        if k < PLAIN:
            fuzz_checks.judge_repeat(batch, k, batch.plain, "plain", report)
    jax.clear_caches()
    return kind, report


def chart(rows: list[dict]):
    """Return a figure of the worst value over its tolerance, by check and scheme."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    schemes = sorted({row["scheme"] for row in rows})
    worst = defaultdict(float)
    for row in rows:
        for check, value in row["worst"].items():
            place = check, row["scheme"]
            worst[place] = max(worst[place], value)
    checks = sorted({check for check, _ in worst})
    figure, axis = plt.subplots(figsize=(6.0, 5.0), layout="constrained")
    for scheme in schemes:
        values = [worst[check, scheme] for check in checks]
        axis.plot(np.maximum(values, 1e-8), range(len(checks)), "o", label=scheme)
    axis.axvline(1.0, color="black", linewidth=1)
    axis.set_xscale("log")
    axis.set_yticks(range(len(checks)), checks)
    axis.set_xlabel("largest deviation / tolerance")
    axis.legend(fontsize=8)
    return figure


def main(argv: list[str] | None = None) -> list[dict]:
    """Fuzz scenes and files."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--cases", type=int, default=20_000, help="random scenes")
    arguments.add_argument("--kinds", type=int, default=45, help="programs they share")
    arguments.add_argument("--files", type=int, default=20_000, help="damaged files")
    arguments.add_argument("--first", type=int, default=0, help="number of the first kind")
    options = measure.parse(arguments, argv)
    if options.quick:
        options.cases, options.kinds, options.files = 30, 3, 100
    each = -(-options.cases // (options.kinds * fuzz.LANES)) * fuzz.LANES
    rows, begin = [], time.perf_counter()
    totals: dict[str, Counter] = defaultdict(Counter)
    for number in range(options.first, options.first + options.kinds):
        kind, report = fuzz_kind(number, range(number * each, (number + 1) * each))
        names = {
            "dimension": kind.dimension,
            "arrangement": kind.arrangement,
            "scheme": type(kind.scheme).__name__,
            "linear_solver": type(kind.linear_solver).__name__,
            "contact_solver": kind.contact_solver,
            "precision": kind.precision,
        }
        for name, value in names.items():
            totals[name][str(value)] += each
        rows.append({
            "kind": number, **names, "cases": each, "counts": dict(report.counts),
            "worst": report.worst, "violations": report.violations, "failures": report.failures,
        })  # fmt: skip
        what = "  ".join(map(str, names.values()))
        found = f"{len(report.violations)} violations, {len(report.failures)} failures"
        print(f"{time.perf_counter() - begin:6.0f} s {number:3d} {what}: {found}", flush=True)
        for violation in report.violations[:5]:
            print("        ", violation, flush=True)
        # A long run keeps what it has.
        measure.save("fuzz", rows, options.out)
    with tempfile.TemporaryDirectory() as folder:
        endings, leaks = damage.fuzz_files(Path(folder), range(options.files))
    summary = {
        "cases": each * options.kinds,
        "violations": sum(len(row["violations"]) for row in rows),
        "failures": sum(len(row["failures"]) for row in rows),
        "checks": dict(sum((Counter(row["counts"]) for row in rows), Counter())),
        "by": {name: dict(counts) for name, counts in totals.items()},
        "files": options.files, "endings": dict(endings), "leaks": leaks,
    }  # fmt: skip
    print(summary)
    measure.save("fuzz", rows, options.out, summary=summary)
    measure.save_chart(chart(rows), "fuzz", options.out)
    return rows


if __name__ == "__main__":
    main()
