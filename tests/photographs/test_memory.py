"""Too little memory: as many photographs at once as fit, and one line where none does."""

import subprocess
import sys
import threading

import cv2
import numpy as np
import pytest

from jaxbundle.photographs import concurrent, reading
from jaxbundle.system import memory
from jaxbundle.system.threads import map_in_threads

LIMITED = """
import resource, sys
import cv2, PIL.Image
from jaxbundle.photographs import read_photograph
pages = int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * 4096 + 150_000_000,) * 2)
try:
    read_photograph(sys.argv[1])
except MemoryError as error:
    print(error)
"""
needs_proc = pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")


@needs_proc
def test_a_photograph_beyond_the_limit_is_named_with_its_size_and_the_remedy(tmp_path):
    file = tmp_path / "large.png"
    assert cv2.imwrite(str(file), np.zeros((18_000, 20_000), np.uint8))  # 360 MB of grey values
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(file)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    for words in (str(file), "20000 × 18000 pixels", "ulimit -v"):
        assert words in done.stdout, done.stdout


@needs_proc
@pytest.mark.parametrize("command, limit, needed", [
    ("adjust nothing.toml", 1_500_000, "1.70 GB"),
    ("reconstruct nothing --out nowhere", 2_500_000, "2.80 GB"),
])  # fmt: skip
def test_a_command_says_what_address_space_it_needs(command, limit, needed):
    limited = f"ulimit -v {limit}; {sys.executable} -m jaxbundle {command}"
    done = subprocess.run(["bash", "-c", limited], capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "ulimit -v" in line and f"{needed} are needed" in line


@pytest.mark.parametrize("error", [
    cv2.error("OpenCV(5.0.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate "
              "18874368 bytes in function 'OutOfMemoryError'"),
    MemoryError(), RuntimeError("can't start new thread"),
    RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 8000 bytes"),
    ImportError("libx.so: failed to map segment from shared object"),
])  # fmt: skip
def test_every_library_s_word_for_no_memory(error):
    with pytest.raises(MemoryError, match="photo.jpg: not enough memory"):
        with reading.image_errors("photo.jpg"):
            raise error


def test_the_photograph_is_named_once_by_the_outer_guard():
    with pytest.raises(MemoryError, match=r"^photo.jpg: not enough memory, [\d.]+ GB"):
        with reading.image_errors("photo.jpg"), reading.image_errors():
            raise MemoryError


def test_other_errors_of_opencv_are_bad_input():
    with pytest.raises(reading.InputError, match="photo.jpg: OpenCV cannot process this image"):
        with reading.image_errors("photo.jpg"):
            cv2.resize(np.zeros((2, 2), np.uint8), (0, 0))


@pytest.mark.parametrize("free, expected", [(np.inf, 8), (4e9, 3), (2e9, 1), (0.0, 1)])
def test_as_many_photographs_as_fit(monkeypatch, free, expected):
    # 1e8 pixels of 2.5 bytes, an arena of 64 MB, and 0.9 GB of work: 1.214 GB each
    monkeypatch.setattr(concurrent, "free_memory", lambda: free)
    assert concurrent.photographs_at_once(1e8, 0.9e9, 8) == expected


def test_what_finds_no_memory_beside_others_is_tried_again_alone():
    running, tried, together = [], [], threading.Barrier(2, timeout=60)

    def work(item):
        running.append(item)
        tried.append(item)
        try:
            if item < 2 and tried.count(item) == 1:
                together.wait()
                raise MemoryError
            return item, len(running)
        finally:
            running.remove(item)

    found = map_in_threads(work, [0, 1, 2], 2)
    assert [item for item, _ in found] == [0, 1, 2]
    assert found[0][1] == found[1][1] == 1 and tried.count(2) == 1


def test_alone_without_memory_is_an_error():
    def work(item):
        raise MemoryError("not enough")

    for at_once_ in (1, 2):
        with pytest.raises(MemoryError, match="not enough"):
            map_in_threads(work, [0, 1], at_once_)


@pytest.mark.parametrize("version", [1, 2])
def test_the_limit_of_a_container_counts_without_cached_files(tmp_path, version):
    group = "a/b"
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text(
        f"0::/{group}\n" if version == 2 else f"5:cpu:/x\n4:memory:/{group}\n0::/\n"
    )
    tree = tmp_path / "sys/fs/cgroup" / ("" if version == 2 else "memory")
    limit, usage, cached = (
        ("memory.max", "memory.current", "inactive_file") if version == 2 else
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
    )  # fmt: skip
    inside = tree / group
    inside.mkdir(parents=True)
    none = "max" if version == 2 else str(2**63 - 4096)
    (inside / limit).write_text(f"{none}\n")
    (inside / usage).write_text("700000000\n")
    assert memory.left_in_control_groups(tmp_path) == np.inf
    # the limit of the parent group binds its children too
    (inside.parent / limit).write_text("1000000000\n")
    (inside.parent / usage).write_text("900000000\n")
    (inside.parent / "memory.stat").write_text(f"anon 5\n{cached} 300000000\n")
    assert memory.left_in_control_groups(tmp_path) == 400_000_000
