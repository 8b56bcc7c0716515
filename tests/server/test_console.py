from __future__ import annotations

import io

import pytest

from real2sim_server.console import StatusLine


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_status_is_written_over_on_a_terminal(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    line = StatusLine()
    line.show("9 of 10, nearly")
    line.show("10 of 10")
    line.end()
    assert terminal.getvalue() == "9 of 10, nearly\r10 of 10       \r        \r"


@pytest.mark.parametrize(("pause", "written"), [(0.0, ["1", "2", "3"]), (3600.0, ["1"])])
def test_a_status_is_a_line_now_and_then_in_a_pipe(monkeypatch, capsys, pause, written):
    monkeypatch.setattr("real2sim_server.console.LINE_EVERY_S", pause)
    line = StatusLine()
    for text in "123":
        line.show(text)
    line.end()
    assert capsys.readouterr().err.split() == written
