"""The size of this machine, without importing Dask."""

from dask.system import cpu_count
from distributed.system import memory_limit

from lidarpool.processes import machine
from poolpart.probe import visible_gpus


def test_the_machine_has_what_dask_and_poolpart_find():
    assert cpu_count() == machine.CPU_COUNT
    assert memory_limit() == machine.MEMORY_LIMIT
    assert machine.gpu_count() == len(visible_gpus())


def test_limits_of_control_groups_count(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_GROUPS", tmp_path)
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.high").write_text("1000\n")
    assert 1000 in machine._memory_limits()
    (tmp_path / "cpu,cpuacct").mkdir()
    (tmp_path / "cpu,cpuacct" / "cpu.cfs_period_us").write_text("100000\n")
    (tmp_path / "cpu,cpuacct" / "cpu.cfs_quota_us").write_text("150000\n")
    assert machine._core_limits()[-1] == 2
    (tmp_path / "cpu,cpuacct" / "cpu.cfs_quota_us").write_text("-1\n")  # no limit
    assert machine._core_limits()[-1] == 0
