"""What was moved is known by what it holds; what nobody can tell was not moved."""

import os
from pathlib import Path

from wm_nodes.training.contents import Contents, content_of, paths_in


def folder_of(path: Path, name: str, text: str) -> str:
    path.mkdir()
    (path / name).write_text(text)
    return str(path)


def test_the_paths_of_a_value_are_all_of_it_or_none() -> None:
    assert paths_in("/a,/b") == paths_in(["/a", "/b"]) == paths_in(("/a", "/b")) == ["/a", "/b"]
    for other in ("", "a", "/a,b", "http://a/v1", ["/a", 1], [], None, 3):
        assert paths_in(other) == []


def test_a_model_a_recording_and_a_file_are_known_by_content_and_nothing_else_is(tmp_path: Path) -> None:
    model, copy = (folder_of(tmp_path / name, "manifest.json", "1") for name in ("model", "copy"))
    bag, other = (folder_of(tmp_path / name, "metadata.yaml", name) for name in ("bag", "other"))
    assert content_of(model) == content_of(copy) == content_of(f"{model}/manifest.json") != ""
    assert content_of(bag) not in ("", content_of(other))
    os.mkfifo(tmp_path / "port")
    for nothing in (tmp_path, tmp_path / "none", tmp_path / "port"):
        assert content_of(str(nothing)) == ""


def test_what_was_kept_of_a_path_decides_and_without_it_what_lies_there_now(tmp_path: Path) -> None:
    model = folder_of(tmp_path / "model", "manifest.json", "1")
    names, folder = [{"model_dir": model, "reward": "rule"}, [f"{tmp_path}/run/weak", "/nothing"]], tmp_path / "run"
    kept = Contents().with_paths(names, folder)
    assert kept.kept == {model: content_of(model)}
    moved = str(Path(model).rename(tmp_path / "moved"))
    other = folder_of(tmp_path / "other", "manifest.json", "2")
    assert kept.were_moved(model, moved) and kept.were_moved([model, other], [moved, other])
    assert not kept.were_moved(model, other) and not kept.were_moved(model, f"{moved},{moved}")
    assert not kept.were_moved(model, "/nothing") and not kept.were_moved("rule", "rules")
    assert not Contents().were_moved(model, moved), "nobody can tell"
    os.symlink(moved, model)
    assert Contents().were_moved(model, moved)
    assert kept.with_paths([model], folder) == kept, "kept as it was first"
