"""A file is the old one or the new one, never a part of one."""

import os
import subprocess
import sys

import pytest

from jaxcontact.transforms.files import atomic_write


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(("mode", "content"), [("wb", b"a\nb\0"), ("w", "a\r\nb\nµ")])
def test_atomic_write_writes_what_it_is_given(tmp_path, mode, content):
    path = tmp_path / "new"
    with atomic_write(str(path), mode) as file:
        file.write(content)
    assert path.read_bytes() == (content if mode == "wb" else content.encode())
    assert names(tmp_path) == ["new"]


def test_atomic_write_that_fails_keeps_the_old_file(tmp_path):
    path = tmp_path / "kept"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_write(path, "w") as file:  # noqa: PT012
        file.write("half of the new")
        file.flush()
        assert path.read_text() == "old"
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert names(tmp_path) == ["kept"]


def test_atomic_write_that_is_killed_keeps_the_old_file(tmp_path):
    path = tmp_path / "kept"
    path.write_text("old")
    script = (
        "import os, sys; from jaxcontact.transforms.files import atomic_write\n"
        "with atomic_write(sys.argv[1], 'w') as file:\n"
        "    file.write('half'); file.flush(); os._exit(9)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run([sys.executable, "-c", script, str(path)], env=environment, check=False)
    assert ended.returncode == 9
    assert path.read_text() == "old"


def test_atomic_write_has_the_permissions_of_any_other_file(tmp_path):
    with atomic_write(tmp_path / "atomic", "w") as file:
        file.write("x")
    (tmp_path / "plain").write_text("x")
    assert (tmp_path / "atomic").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_atomic_write_follows_a_link(tmp_path):
    (tmp_path / "target").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "target")
    with atomic_write(tmp_path / "link", "w") as file:
        file.write("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "target").read_text() == "new"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_atomic_write_into_a_pipe_writes_through_it(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    with atomic_write(pipe, "wb") as file:
        file.write(b"x")
    assert os.read(reader, 9) == b"x"
    os.close(reader)
    assert pipe.is_fifo()


def test_atomic_write_into_no_folder_raises(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_write(tmp_path / "no" / "file", "w"):
        pass
