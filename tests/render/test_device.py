"""What nvidia-smi tells, and engines that render on the processor only."""

from __future__ import annotations

from pathlib import Path

import pytest

from droguekit.batch.execution import default_workers
from render.device import gpu_model, query_gpu
from render.engine import EngineUnavailableError, load_engine


@pytest.fixture
def tool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The only program on the path: an nvidia-smi that tells its arguments to a file, and a number."""
    path = tmp_path / "nvidia-smi"
    path.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/asked\necho 8192.00\n')
    path.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    return path


def test_the_chosen_gpu_is_asked(tool: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert query_gpu("memory.free") == 8192.0
    asked = tool.with_name("asked").read_text().split()
    assert asked == ["--query-gpu=memory.free", "--format=csv,noheader,nounits", "-i", "0"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-1234,GPU-5678")
    query_gpu("power.draw")
    asked = tool.with_name("asked").read_text().split()
    assert asked == ["--query-gpu=power.draw", "--format=csv,noheader,nounits", "-i", "GPU-1234"]


@pytest.mark.parametrize("script", ["echo '[N/A]'", "echo No devices were found; exit 6", None])
def test_nothing_is_known_where_the_tool_tells_no_number(tool: Path, script: str | None) -> None:
    if script is None:
        tool.unlink()
    else:
        tool.write_text(f"#!/bin/sh\n{script}\n")
    assert query_gpu("power.draw") is None


def test_a_gpu_is_known_by_its_model(tool: Path) -> None:
    tool.write_text("#!/bin/sh\necho 'NVIDIA H100 80GB HBM3'\n")
    assert gpu_model() == "NVIDIA H100 80GB HBM3"
    tool.unlink()
    assert gpu_model() is None


def test_a_gpu_holds_as_many_workers_as_its_memory(tool: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("droguekit.batch.execution.available_cores", lambda: 64)
    monkeypatch.setattr("droguekit.batch.execution.available_memory_gib", lambda: 300.0)
    assert default_workers() == 64
    assert default_workers("cuda") == 4
    tool.write_text("#!/bin/sh\necho 100.00\n")
    assert default_workers("cuda") == 1
    tool.unlink()
    assert default_workers("cuda") == 64


def test_an_engine_of_the_processor_refuses_a_gpu() -> None:
    with pytest.raises(EngineUnavailableError, match=r"^device cuda: engine analytic renders on the processor only"):
        load_engine("analytic", "cuda")


def test_a_device_has_a_known_name() -> None:
    with pytest.raises(ValueError, match=r"^device: must be cpu or cuda, got 'gpu'$"):
        load_engine("analytic", "gpu")  # type: ignore[arg-type]
