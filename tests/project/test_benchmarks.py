"""Claims about the benchmarks: all are listed, they run and keep what they measured."""

import importlib
import json
import re
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
#: Columns whose values the documentation quotes.
RESULTS = {
    "step_cost": ["step_us", "limit_us", "step_over_limit"],
    "against_numpy": ["forward_superlu_over_ours", "gradient_superlu_over_ours"],
    "gradient_cost": ["time_ratio", "memory_ratio"],
    "batch": ["forward_per_scene_over_single", "gradient_per_scene_over_single"],
    "compile_time": ["forward_s", "gradient_s"],
    "contact_solvers": ["newton_cold_us", "newton_warm_us", "gauss_seidel_us"],
    "gradient_convergence": ["gradient"],
    "identification": ["median_miss", "median_gradients"],
    "two_bodies": ["stress_error", "pressure_error", "load_over_one_body", "two_over_one"],
    "large_motion": ["frames_error", "residual", "energy", "frames_over_small"],
    "reduction": [
        *("displacement_A", "gradient_A", "gradient_speedup", "out_of_reach_over_without"),
        *("optimisation_speedup", "gradient_vmap", "gradient_spread"),
    ],
    "speed_accuracy": ["displacement", "gradient_s"],
    "recommend": ["error", "median_effectivity", "effectivity_displacement"],
}


def test_benchmark_index_has_a_row_for_every_script_and_every_result():
    index = (FOLDER / "README.md").read_text(encoding="utf-8")
    rows = [line for line in index.splitlines() if re.match(r"\|.*`\w+\.py`", line)]
    scripts = sorted(path.name for path in FOLDER.glob("*.py"))
    assert sorted(name for row in rows for name in re.findall(r"`(\w+\.py)`", row)) == scripts
    named = {name for row in rows for name in re.findall(r"`(\w+\.(?:json|png))`", row)}
    assert named == {path.name for path in (FOLDER / "results").iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("name", RESULTS)
def test_benchmark_writes_what_it_measured(name, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    plt.switch_backend("agg")
    benchmark = importlib.import_module(name)
    rows = benchmark.main(["--quick", "--repeats", "2", "--out", str(tmp_path)])
    record = json.loads((tmp_path / f"{name}.json").read_text())
    assert record["rows"] == json.loads(json.dumps(rows, default=str))
    assert record["machine"]["cores"] >= 1
    assert (tmp_path / f"{name}.png").stat().st_size > 1000
    for row in record["rows"]:
        # The rows of one benchmark may answer several questions.
        values = [row[column] for column in RESULTS[name] if column in row]
        assert values
        assert np.all(np.isfinite(values))
        assert np.all(np.abs(values) > 0.0)
