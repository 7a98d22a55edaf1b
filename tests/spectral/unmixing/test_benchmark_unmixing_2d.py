"""The contract of benchmarks/unmixing_2d.py with scripts outside this repository."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import savemat

from tests.spectral.mixtures import seeded, smooth_endmembers

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "unmixing_2d.py"


def run(*arguments):
    return subprocess.run(
        [sys.executable, str(SCRIPT), *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.fixture
def image():
    """Y, A and M as MATLAB users store them, in units of a thousand."""
    materials = smooth_endmembers(3, 12).numpy()
    shares = torch.rand(300, 3, generator=seeded(), dtype=torch.float64).numpy() ** 4
    shares = shares / shares.sum(axis=1, keepdims=True)
    return {"Y": 1000 * (shares @ materials).T, "A": shares.T, "M": materials.T}


def test_medians_and_spreads_are_printed_as_json_whatever_is_transposed(tmp_path, image):
    reports = []
    for name, content in (("plain", image), ("turned", {key: image[key].T for key in image})):
        savemat(tmp_path / f"{name}.mat", content)
        ended = run(
            tmp_path / f"{name}.mat",
            "--endmembers",
            3,
            "--seeds",
            2,
            "--json",
            "--rows",
            "pairs, NNLS",
            "VCA, FCLS",
        )
        assert ended.returncode == 0, ended.stderr
        reports.append(json.loads(ended.stdout))
    assert reports[0]["methods"] == reports[1]["methods"]
    assert set(reports[0]["methods"]) == {"pairs, NNLS", "VCA, FCLS"}
    for figures in reports[0]["methods"].values():
        for key in ("abundance_rmse", "endmember_angle"):
            values = figures[key]["values"]
            assert figures[key]["median"] == pytest.approx(np.median(values))
            assert figures[key]["spread"] == pytest.approx(max(values) - min(values))
            assert figures[key]["standard_deviation"] == pytest.approx(np.std(values))
    assert reports[0]["methods"]["VCA, FCLS"]["abundance_rmse"]["median"] < 0.1


def test_bad_input_is_one_message_and_exit_code_2(tmp_path, image):
    (tmp_path / "text.mat").write_text("no matrix")
    savemat(tmp_path / "no_truth.mat", {"Y": image["Y"]})
    savemat(tmp_path / "short.mat", image | {"A": image["A"][:, :-1]})
    savemat(tmp_path / "whole.mat", image)
    cases = {
        (tmp_path / "absent.mat",): "there is no file or folder",
        (tmp_path / "text.mat",): "can't be read as a .mat file",
        (tmp_path / "no_truth.mat",): "has no 'A'; found Y",
        (tmp_path / "short.mat",): "expected Y (bands, pixels)",
        (tmp_path / "whole.mat", "--endmembers", 4): "there are 3 true materials",
        (tmp_path / "whole.mat", "--rows", "magic"): "no method is called 'magic'",
    }
    for arguments, message in cases.items():
        ended = run(*arguments)
        assert ended.returncode == 2
        assert message in ended.stderr
        assert ended.stderr.count("\n") == 1
