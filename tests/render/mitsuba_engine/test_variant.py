"""The variant for a GPU: why there is none, told before anything starts; and what is remembered of one.

No GPU is needed: small libraries stand in for NVIDIA's driver.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from droguekit.cli.main import WRONG_INPUT, run
from render.engine import EngineUnavailableError, engine_notice
from render.mitsuba_engine import gpu_trial, variant
from render.mitsuba_engine.variant import Variant, probe_variant

pytestmark = pytest.mark.mitsuba

DRIVER = """
#include <string.h>
int cuInit(unsigned flags) { return INIT; }
int cuDriverGetVersion(int *version) { *version = 12040; return 0; }
int cuDeviceGetCount(int *count) { *count = COUNT; return 0; }
int cuDeviceGetName(char *name, int size, int device) { strncpy(name, "NVIDIA Test 1", size); return 0; }
int cuDeviceGetAttribute(int *value, int attribute, int device) { *value = attribute == 75 ? MAJOR : 5; return 0; }
"""
KERNEL_MODULES = {
    "NVRM version: NVIDIA UNIX x86_64 Kernel Module  535.104.05  Sat Aug 19 01:15:15 UTC 2023\nGCC version: 12.2.0\n": (
        "driver 535.104.05"
    ),
    "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  550.54.14  Release Build  (x@y)  Thu Feb 22 2024": (
        "driver 550.54.14"
    ),
    "": "CUDA 12.4",
}


@pytest.fixture(autouse=True)
def no_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache of verdicts for this test alone."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def driver(folder: Path, init: int = 0, count: int = 1, major: int = 8) -> str:
    """Compile a library with the driver's functions, and return its path."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    source, library = folder / "driver.c", folder / "libcuda.so"
    source.write_text(DRIVER)
    values = [f"-DINIT={init}", f"-DCOUNT={count}", f"-DMAJOR={major}"]
    subprocess.run([compiler, "-shared", "-fPIC", *values, str(source), "-o", str(library)], check=True)
    return str(library)


def test_a_user_without_a_home_has_no_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        # As `Path.home` where HOME is not set and the user has no entry in the system's list.
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", no_home)
    variant._store_verdict("key", True)
    assert variant._verdicts() == {}


@pytest.mark.parametrize("home", [None, "/proc", "/no/such/folder"])
def test_a_home_that_cannot_be_written_does_not_stop_mitsuba(home: str | None, tmp_path: Path) -> None:
    code = (
        "from render.mitsuba_engine.variant import probe_variant; chosen = probe_variant(); import mitsuba; "
        "mitsuba.set_variant(chosen.variant); print(chosen.variant)"
    )
    environment = {name: value for name, value in os.environ.items() if name not in ("HOME", "XDG_CACHE_HOME")}
    environment |= {"PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)}
    if home is not None:
        environment["HOME"] = home
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, probe_variant().variant), done.stderr
    assert list(tmp_path.glob("droguekit-*")) == []


class LlvmTrials:
    """Stands in for the process that tries an LLVM library; None for one that takes too long."""

    def __init__(self, *ends: int | None) -> None:
        self.ends = [*ends]

    def __call__(self, arguments: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[bytes]:
        status = self.ends.pop(0)
        if status is None:
            raise subprocess.TimeoutExpired(arguments, 1.0)
        return subprocess.CompletedProcess(arguments, status, b"works" if status == 0 else b"", b"")


@pytest.mark.parametrize("end", [None, -9, -6, 1])
def test_only_what_works_is_remembered_of_a_library(
    end: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = tmp_path / "libLLVM-19.so.1"
    library.touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(library))
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("DROGUEKIT_REJECTED_LLVM", "")
    monkeypatch.setattr(variant, "_tried", LlvmTrials(end, 0))
    # A process and the workers that it starts agree.
    assert [probe_variant().variant for _ in range(2)] == ["scalar_rgb", "scalar_rgb"]
    assert not variant.verdicts_file().exists()
    # The next run tries again.
    monkeypatch.setenv("DROGUEKIT_REJECTED_LLVM", "")
    assert [probe_variant().variant for _ in range(2)] == ["llvm_ad_rgb", "llvm_ad_rgb"]
    # What an older version wrote.
    verdicts = json.loads(variant.verdicts_file().read_text())
    variant.verdicts_file().write_text(json.dumps(dict.fromkeys(verdicts, False)))
    monkeypatch.setattr(variant, "_tried", LlvmTrials(0))
    assert probe_variant().variant == "llvm_ad_rgb"


_SQUARE = (
    "from render.mitsuba_engine.variant import probe_variant\n"
    "probe_variant(); import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import drjit as dr\n"
    "x = mi.Float(3.0) + dr.opaque(mi.Float, 1.5); dr.eval(x * x)"
)


def compile_kernel(home: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "HOME": str(home), "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.run([sys.executable, "-c", _SQUARE], env=environment, capture_output=True, text=True, check=False)


def kernels(home: Path) -> list[Path]:
    return sorted((home / ".drjit").glob("*.bin"))


def test_kernels_that_cannot_be_loaded_are_swept(tmp_path: Path) -> None:
    if probe_variant().variant != "llvm_ad_rgb":
        pytest.skip("no LLVM here")
    done = compile_kernel(tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    whole = {path: path.read_bytes() for path in kernels(tmp_path)}
    for path, damaged in zip(whole, (b"", b"\5\0", whole[kernels(tmp_path)[-1]][:-1]), strict=False):
        path.write_bytes(damaged)
        stale = path.with_name(f"{path.name}.tmp")
        stale.touch()
        os.utime(stale, (0, 0))
    done = compile_kernel(tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert {path: path.read_bytes() for path in kernels(tmp_path)} == whole


def test_a_sweep_leaves_whole_kernels_and_all_else(tmp_path: Path) -> None:
    contents = {
        f"{'0' * 32}.llvm.bin": struct.pack("<BIIII", 5, 4, 9, 9, 9) + b"1234",
        f"{'1' * 32}.llvm.v7.bin": struct.pack("<BIIII", 7, 99, 9, 9, 9) + b"of a later version",
        f"{'2' * 32}.llvm.bin.tmp": b"being written",
        "notes.txt": b"",
    }
    for name, data in contents.items():
        (tmp_path / name).write_bytes(data)
    variant.sweep_kernel_cache(tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == contents
    variant.sweep_kernel_cache(tmp_path / "none")


def refusal() -> str:
    with pytest.raises(EngineUnavailableError) as caught:
        engine_notice("mitsuba", "cuda")
    return str(caught.value)


def test_a_missing_driver_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent/libcuda.so.1")
    assert refusal() == (
        "device cuda: no NVIDIA driver, as /nonexistent/libcuda.so.1 cannot be loaded; install driver 535 or newer, or "
        "take device cpu"
    )


def test_a_missing_gpu_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # cuda.h: CUDA_ERROR_NO_DEVICE is 100.
    for library in (driver(tmp_path, init=100), driver(tmp_path, count=0)):
        monkeypatch.setenv("DRJIT_LIBCUDA_PATH", library)
        assert refusal().startswith("device cuda: NVIDIA's driver finds no GPU; look with nvidia-smi")


def test_a_driver_that_does_not_start_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", driver(tmp_path, init=803))
    assert "NVIDIA's driver does not start (CUDA error 803)" in refusal()


def test_an_old_gpu_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", driver(tmp_path, major=6))
    monkeypatch.setattr("render.device._KERNEL_MODULE", tmp_path / "none")
    assert (
        "NVIDIA Test 1" in refusal() and "has compute capability 6.5 and Mitsuba needs 7.5; take a newer" in refusal()
    )


def test_missing_optix_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", driver(tmp_path))
    monkeypatch.setenv("DRJIT_LIBOPTIX_PATH", "/nonexistent/libnvoptix.so.1")
    assert "OptiX is missing, as /nonexistent/libnvoptix.so.1 cannot be loaded" in refusal()
    assert "NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics, or take device cpu" in refusal()


@pytest.mark.parametrize("module", KERNEL_MODULES)
def test_name_and_driver_of_a_gpu(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", driver(tmp_path))
    (tmp_path / "version").write_text(module)
    monkeypatch.setattr("render.device._KERNEL_MODULE", tmp_path / "version")
    assert gpu_trial.gpu_name() == f"NVIDIA Test 1, {KERNEL_MODULES[module]}"


class Trials:
    """Stands in for the process of a trial, and counts."""

    def __init__(self, stdout: str, status: int = 0) -> None:
        self.stdout, self.status, self.count = stdout, status, 0

    def __call__(self, arguments: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess[bytes]:
        assert arguments == ["-P", "-m", "render.mitsuba_engine.gpu_trial"]
        self.count += 1
        return subprocess.CompletedProcess(arguments, self.status, self.stdout.encode(), b"")


def test_a_gpu_is_tried_once_for_each_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    trials = Trials(json.dumps({"gpu": "NVIDIA Test 1, driver 550.54.14"}))
    monkeypatch.setattr(variant, "_tried", trials)
    for module in ("550.54.14", "550.54.14", "570.1"):
        monkeypatch.setattr(variant, "kernel_module", lambda module=module: module)
        found = probe_variant("cuda")
        assert (found.variant, found.gpu, found.library) == ("cuda_ad_rgb", "NVIDIA Test 1, driver 550.54.14", None)
        assert engine_notice("mitsuba", "cuda") is None
    assert trials.count == 2
    # Another GPU may have been chosen.
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    probe_variant("cuda")
    assert trials.count == 3


def test_a_failure_is_not_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variant, "kernel_module", lambda: "550.54.14")
    trials = Trials(json.dumps({"fault": "out of memory"}))
    monkeypatch.setattr(variant, "_tried", trials)
    for _ in range(2):
        assert refusal() == "device cuda: out of memory, or take device cpu"
    assert trials.count == 2


def test_a_trial_that_dies_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variant, "_tried", Trials("", -6))
    assert refusal() == "device cuda: a trial ended with status -6; look for a newer driver, or take device cpu"


def test_pixels_are_of_one_gpu_and_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the records of frames name, by which a dataset refuses frames of another device."""
    from render.mitsuba_engine.mitsuba_engine import engine_version

    on_gpu = Variant("cuda_ad_rgb", "the GPU works", gpu="NVIDIA Test 1, driver 550.54.14")
    assert " cuda_ad_rgb (NVIDIA Test 1, driver 550.54.14), render version " in engine_version(on_gpu)
    assert " llvm_ad_rgb, render version " in engine_version(Variant("llvm_ad_rgb", "LLVM works", Path("libLLVM.so")))


@pytest.mark.parametrize(
    "arguments",
    [
        ["render", "smoke", "--out", "{out}"],
        ["demo", "smoke", "--out", "{out}"],
        ["bench"],
        ["plan", "smoke"],
    ],
)
def test_commands_end_with_one_line_before_any_work(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent/libcuda.so.1")
    code = run([*(word.replace("{out}", str(out)) for word in arguments), "--device", "cuda"])
    told = capsys.readouterr().err
    last = told.splitlines()[-1]
    assert code == WRONG_INPUT
    assert last.startswith("droguekit: error: device cuda: no NVIDIA driver") and last.endswith("or take device cpu")
    assert "Traceback" not in told and not (out / "frames").exists()
