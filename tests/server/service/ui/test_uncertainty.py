"""Uncertainty images in the studio."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from real2sim_server.scene.io import save_scene

from .hands import shown

pytestmark = [pytest.mark.browser, pytest.mark.network]


@pytest.fixture
def running(scenes_dir, tiny_scene, running) -> Any:
    """A worker that also has the scene ``known``."""
    background = replace(
        tiny_scene.background, uncertainties=torch.full((len(tiny_scene.background),), 0.02)
    )
    save_scene(replace(tiny_scene, name="known", background=background), scenes_dir / "known.r2s")
    return running


def opened(page: Any, scene: str) -> None:
    page.click(f"[data-scene={scene}]")
    page.wait_for_selector("body[data-ready]")


def test_uncertainty_is_toggled_and_kept_in_the_link(page, visit):
    opened(page, "known")
    page.wait_for_selector("#picture[data-seq]")
    coloured = page.get_attribute("#picture", "src")
    page.click("#uncertainty")
    page.wait_for_function("src => document.getElementById('picture').src !== src", arg=coloured)
    page.wait_for_url("**shows=uncertainty**")
    again = visit(page.url)
    again.wait_for_selector("body[data-ready]")
    assert shown(again, "model.shows") == "uncertainty"
    again.keyboard.press("u")
    assert shown(again, "model.shows") == "rgb"


def test_scenes_without_uncertainties_have_no_button(page):
    opened(page, "tiny")
    assert not page.is_visible("#uncertainty")
    page.keyboard.press("u")
    assert shown(page, "model.shows") == "rgb"
