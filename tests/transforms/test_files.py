"""A file is the old one or the new one, never a part of one."""

import errno
import os
import subprocess
import sys

import pytest

from jaxcontact.transforms.files import atomic_write, check_is_file, make_folder


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


def test_atomic_write_into_no_folder_says_what_to_do(tmp_path):
    message = "cannot write .*no.file: No such file.*choose a place in a folder that exists"
    with (
        pytest.raises(FileNotFoundError, match=message),
        atomic_write(tmp_path / "no" / "file", "w"),
    ):
        pass


def test_atomic_write_on_a_folder_asks_for_a_file_in_it(tmp_path):
    message = f"{tmp_path} is a folder; name a file in it"
    with pytest.raises(IsADirectoryError, match=message), atomic_write(tmp_path, "w"):
        pass
    assert names(tmp_path) == []


def full_disk(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("function", ["fsync", "replace"])
def test_atomic_write_on_a_full_disk_keeps_the_old_file_and_says_so(
    tmp_path, monkeypatch, function
):
    path = tmp_path / "kept"
    path.write_text("old")
    monkeypatch.setattr(os, function, full_disk)
    message = "^cannot write .*kept: No space left on device; choose .* and has room$"
    with pytest.raises(OSError, match=message) as full, atomic_write(path, "w") as file:
        file.write("new")
    assert full.value.errno == errno.ENOSPC
    assert path.read_text() == "old"
    assert names(tmp_path) == ["kept"]


def test_atomic_write_into_a_folder_that_is_read_only_says_so(tmp_path):
    tmp_path.chmod(0o500)
    if os.access(tmp_path, os.W_OK):
        pytest.skip("this user may write everywhere")
    message = "cannot write .*file: Permission denied; choose"
    with pytest.raises(PermissionError, match=message), atomic_write(tmp_path / "file", "w"):
        pass


def test_make_folder_where_a_file_is_says_so(tmp_path):
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    (tmp_path / "a" / "b" / "c").write_text("mine")
    with pytest.raises(FileExistsError, match=r"cannot make the folder .*c: File exists; choose"):
        make_folder(tmp_path / "a" / "b" / "c")


def test_check_is_file_names_what_is_missing_or_a_folder(tmp_path):
    (tmp_path / "file").write_text("x")
    check_is_file(tmp_path / "file")
    with pytest.raises(FileNotFoundError, match=f"no file {tmp_path}/none; check its name"):
        check_is_file(tmp_path / "none")
    with pytest.raises(IsADirectoryError, match=f"{tmp_path} is a folder; name a file in it"):
        check_is_file(tmp_path)
