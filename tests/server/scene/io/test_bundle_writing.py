from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from real2sim_server.scene import BundleError, SceneError
from real2sim_server.scene.io import container, load_scene, save_scene


def test_an_existing_bundle_is_kept_without_overwrite(scene, bundle):
    with pytest.raises(BundleError, match="overwrite=True"):
        save_scene(replace(scene, name="other"), bundle)
    assert load_scene(bundle).name == "street"


def test_an_existing_bundle_is_replaced_with_overwrite(scene, bundle, tmp_path):
    save_scene(replace(scene, name="other", sky=None), bundle, overwrite=True)
    loaded = load_scene(bundle)
    assert (loaded.name, loaded.sky) == ("other", None)
    assert [f.name for f in tmp_path.iterdir()] == ["street.r2s"]


def test_a_folder_with_other_files_is_never_replaced(scene, tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(BundleError, match="never replaced"):
        save_scene(scene, tmp_path, overwrite=True)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_file_is_never_replaced(scene, tmp_path):
    (tmp_path / "file").write_text("text")
    with pytest.raises(BundleError, match="is not a folder"):
        save_scene(scene, tmp_path / "file", overwrite=True)


def test_a_scene_can_be_saved_to_an_empty_folder(scene, tmp_path):
    (tmp_path / "new").mkdir()
    save_scene(scene, tmp_path / "new")
    assert load_scene(tmp_path / "new").name == "street"


@pytest.mark.parametrize("failing", ["write_tensors", "write_text", "rename"])
def test_a_failed_write_keeps_the_old_bundle(scene, bundle, tmp_path, monkeypatch, failing):
    def fail(*args: object, **kwargs: object) -> None:
        raise OSError(28, "no space left on device")

    if failing == "write_tensors":
        monkeypatch.setattr(container, "write_tensors", fail)
    elif failing == "write_text":
        monkeypatch.setattr(Path, "write_text", fail)
    else:
        rename = Path.rename
        monkeypatch.setattr(
            Path, "rename", lambda self, to: fail() if ".tmp-" in self.name else rename(self, to)
        )
    with pytest.raises(OSError, match="no space left"):
        save_scene(replace(scene, name="other"), bundle, overwrite=True)
    monkeypatch.undo()
    assert load_scene(bundle).name == "street"
    assert [f.name for f in tmp_path.iterdir()] == ["street.r2s"]


def test_all_files_have_the_same_permissions(bundle):
    assert len({file.stat().st_mode for file in bundle.iterdir()}) == 1


def test_non_finite_values_are_not_written(scene, tmp_path):
    means = scene.object("car_3").cloud.means.clone()
    means[4, 1] = float("nan")
    car = replace(scene.object("car_3"), cloud=replace(scene.object("car_3").cloud, means=means))
    bad = replace(scene, objects=dict(scene.objects) | {"car_3": car})
    with pytest.raises(SceneError, match=r"object 'car_3': 1 of 63 values: means not finite"):
        save_scene(bad, tmp_path / "bad")
    assert not (tmp_path / "bad").exists()


@pytest.mark.parametrize("value", [np.float64(1).reshape(1), {1, 2}, float("nan")])
def test_provenance_that_is_not_json_is_not_written(scene, tmp_path, value):
    with pytest.raises(SceneError, match="JSON values only"):
        save_scene(replace(scene, provenance={"x": value}), tmp_path / "bad")
    assert not list(tmp_path.iterdir())
