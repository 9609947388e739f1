"""The benchmark harness: what it counts as compilation, how it compares, what it writes."""

import json
from pathlib import Path

import jax
import pytest
from harness import Benchmark, Measurement, markdown, provenance, ratios


@pytest.fixture(autouse=True)
def restore_cache():
    enabled = jax.config.values["jax_enable_compilation_cache"]
    yield
    jax.config.update("jax_enable_compilation_cache", enabled)


def test_warm_up_is_not_counted() -> None:
    calls = []
    bench = Benchmark("subject")
    result = bench.time("work", lambda x: calls.append(x) or len(calls), 5, repeats=4)
    (measured,) = bench.measurements
    assert measured.repeats == 4 and result == len(calls) == 6
    assert measured.best is not None and measured.median is not None
    assert measured.compile is not None and 0 <= measured.best <= measured.median


def test_a_measurement_has_one_name_to_a_program() -> None:
    bench = Benchmark("subject")
    bench.record(Measurement("work", best=1.0))
    bench.record(Measurement("work", best=1.0, program="peer"))
    with pytest.raises(ValueError, match="twice"):
        bench.record(Measurement("work", best=2.0))


def test_results_are_written_compared_and_judged(tmp_path: Path) -> None:
    arguments = ["--output", str(tmp_path)]
    first = Benchmark("subject")
    first.record(Measurement("work", best=1.0, values={"error (px)": 0.25}))
    before = first.finish(arguments)
    assert json.loads((tmp_path / "subject.json").read_text("utf-8")) == before

    second = Benchmark("subject")
    second.record(Measurement("work", best=3.0))
    second.record(Measurement("more", best=1.0))
    with pytest.raises(SystemExit, match="slower"):
        second.finish([*arguments, "--no-write", "--fail-above", "2"])
    assert json.loads((tmp_path / "subject.json").read_text("utf-8")) == before
    after = second.finish([*arguments, "--fail-above", "4"])
    assert ratios(after, before) == {"jaxface: work": 3.0}
    table = markdown(after, before)
    assert "3.00" in table and "new" in table
    assert "error (px)" in markdown(before) and "0.25" in markdown(before)


def test_provenance_names_versions_and_no_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("platform.node", "socket.gethostname", "socket.getfqdn", "getpass.getuser"):
        monkeypatch.setattr(name, lambda *_: "secret")
    monkeypatch.setenv("USER", "secret")
    found = provenance(["jax", "no-such-package"])
    assert "secret" not in json.dumps(found)
    assert (
        found["versions"]["jax"] == jax.__version__ and "no-such-package" not in found["versions"]
    )
    assert found["cores"] >= 1 and "hostname" not in found and "node" not in found
