from __future__ import annotations

import json

import pytest

from real2sim_bench import edit

pytestmark = pytest.mark.network


@pytest.mark.slow
def test_a_short_run_reports_all_edits_and_openings(capsys):
    figures = edit.run(edit.EditBenchOptions(operations=40, gaussians=20_000))

    assert json.loads(json.dumps(figures)) == figures
    assert figures["append_ms"]["count"] == 40
    assert figures["open_ms"]["count"] == edit.OPENINGS
    assert "append" in capsys.readouterr().out


def test_edits_have_the_requested_count_and_are_deterministic():
    first, again = (edit._edits(["a", "b"], 333) for _ in range(2))

    assert len(first) == 333
    assert first == again
