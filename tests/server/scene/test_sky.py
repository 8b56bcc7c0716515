import numpy as np
import pytest
import torch

from real2sim_server.scene import SceneError, Sky
from real2sim_server.scene.scene import face_coordinates, face_directions


@pytest.fixture
def sky() -> Sky:
    return Sky(torch.rand(6, 8, 8, 3, generator=torch.Generator().manual_seed(0)))


def test_sampling_at_pixel_centres_returns_the_texels(sky):
    directions = torch.from_numpy(face_directions(sky.resolution))
    torch.testing.assert_close(sky.sample(directions), sky.faces, atol=1e-5, rtol=0)


def test_direction_length_does_not_matter(sky):
    directions = torch.from_numpy(face_directions(5))
    torch.testing.assert_close(sky.sample(directions * 37), sky.sample(directions))


def test_face_coordinates_invert_face_directions():
    r = 6
    face, u, v = face_coordinates(torch.from_numpy(face_directions(r)))
    centre = (torch.arange(r) + 0.5) / r * 2 - 1
    assert (face == torch.arange(6)[:, None, None]).all()
    torch.testing.assert_close(u, centre.expand(6, r, r))
    torch.testing.assert_close(v, centre[:, None].expand(6, r, r))


@pytest.mark.parametrize(
    ("direction", "face"),
    [
        ([1, 0, 0], 0),
        ([-1, 0, 0], 1),
        ([0, 1, 0], 2),
        ([0, -1, 0], 3),
        ([0, 0, 1], 4),
        ([0, 0, -1], 5),
    ],
)
def test_axes_map_to_their_faces(direction, face):
    sky = Sky(torch.arange(6.0)[:, None, None, None].expand(6, 2, 2, 3).contiguous())
    assert sky.sample(torch.tensor(direction, dtype=torch.float32)).tolist() == [face] * 3


def test_side_faces_are_upright():
    faces = torch.zeros(6, 8, 8, 3)
    faces[:4, :4] = 1
    directions = torch.tensor([[x, y, 0.5] for x, y in [(1, 0.1), (-1, 0.1), (0.1, 1), (0.1, -1)]])
    assert (Sky(faces).sample(directions) == 1).all()
    assert (Sky(faces).sample(directions * torch.tensor([1, 1, -1])) == 0).all()


def test_colour_changes_continuously_inside_a_face(sky):
    angle = torch.linspace(-0.7, 0.7, 2001)
    arc = torch.stack([angle.cos(), angle.sin(), torch.full_like(angle, 0.123)], -1)
    steps = sky.sample(arc).diff(dim=0).abs().max()
    assert 0 < steps < 0.02


def test_uniform_sky_is_one_colour():
    directions = torch.from_numpy(face_directions(3))
    colours = Sky.uniform((0.2, 0.4, 0.6)).sample(directions)
    torch.testing.assert_close(colours, torch.tensor([0.2, 0.4, 0.6]).expand(6, 3, 3, 3))


def test_directions_have_unit_length():
    np.testing.assert_allclose(np.linalg.norm(face_directions(4), axis=-1), 1, rtol=1e-6)


@pytest.mark.parametrize(
    "faces", [torch.zeros(5, 2, 2, 3), torch.zeros(6, 2, 3, 3), torch.zeros(6, 0, 0, 3)]
)
def test_wrong_shapes_are_refused(faces):
    with pytest.raises(SceneError, match=r"\[6, R, R, 3\]"):
        Sky(faces)


def test_other_dtypes_are_refused():
    with pytest.raises(SceneError, match="float32"):
        Sky(torch.zeros(6, 2, 2, 3, dtype=torch.float64))
