"""Pictures of the gallery."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from real2sim_server.scenarios.gallery import GALLERY, shipped_picture
from real2sim_server.scenarios.picture import EGO, picture_of, plain_scene

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def scene():
    return plain_scene()


@pytest.mark.parametrize("name", GALLERY)
def test_the_shipped_picture_matches_the_case(scene, name):
    """Made anew by ``python -m real2sim_server.scenarios.picture``."""
    assert shipped_picture(name).decode() == picture_of(GALLERY[name], scene)


def test_a_picture_shows_the_title_and_everybody_at_start_and_end():
    root = ET.fromstring(shipped_picture("cut_out"))
    assert root.find(f"{SVG}title").text == GALLERY["cut_out"].title
    colours = [box.get("fill") for box in root.iter(f"{SVG}polygon")]
    assert len(colours) == 6
    assert colours.count(EGO) == 2
    low, top, width, height = map(float, root.get("viewBox").split())
    assert width / height == pytest.approx(3.0, abs=0.02)
    for box in root.iter(f"{SVG}polygon"):
        for corner in box.get("points").split():
            x, y = map(float, corner.split(","))
            assert low <= x <= low + width
            assert top <= y <= top + height
