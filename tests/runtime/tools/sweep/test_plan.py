"""Which runs a sweep consists of."""

from __future__ import annotations

import itertools
import pickle
import tomllib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runtime.config.reading import load
from runtime.errors import ConfigError
from runtime.tools.sweep import make_plan
from tests.runtime.tools.flights.samples import flight_file
from tests.runtime.tools.sweep.samples import judge_file, plan_in


@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(st.integers(1, 99), min_size=1, max_size=3, unique=True),
    st.lists(st.integers(0, 99), min_size=1, max_size=3, unique=True),
    st.integers(1, 3),
)
def test_every_combination_once_the_first_parameter_slowest(
    tmp_path: Path, rates: list[int], latencies: list[int], seeds: int
) -> None:
    vary = [f"judge.rate={','.join(map(str, rates))}"]
    vary += [f"judge.latency={','.join(f'{ms}ms' for ms in latencies)}"]
    plan = plan_in(tmp_path, *vary, seeds=seeds)
    combinations = [(*(text for _, text in job.settings), job.seed) for job in plan.jobs]
    names = [str(rate) for rate in rates], [f"{ms}ms" for ms in latencies]
    assert combinations == list(itertools.product(*names, range(3, 3 + seeds)))
    assert len({job.id for job in plan.jobs}) == len(plan.jobs)


def test_a_job_is_the_whole_file_with_its_changes_and_survives_pickling(tmp_path: Path) -> None:
    plan = plan_in(tmp_path, "judge.rate=5,6", overrides=["judge.limit=7", "run.seed=8"], seeds=2)
    job = pickle.loads(pickle.dumps(plan.jobs[-1]))
    assert job == plan.jobs[-1]
    again = tmp_path / "again.toml"
    again.write_text(job.text, encoding="utf-8")
    overrides = ["judge.rate=6", "judge.limit=7", "run.seed=9"]
    assert load(again) == load(tmp_path / "judge.toml", overrides)
    assert (job.folder, str(job)) == (str(tmp_path), "judge.rate=6 seed=9")
    assert tomllib.loads(job.text)["run"]["seed"] == job.seed == 9
    assert Path(job.out) == tmp_path / "out" / "runs" / job.id


def test_a_job_has_the_same_id_in_any_sweep_that_has_it(tmp_path: Path) -> None:
    few = plan_in(tmp_path, "judge.rate=5,6")
    many = plan_in(tmp_path, "judge.rate=1,6,5", seeds=4)
    assert {job.id for job in few.jobs} < {job.id for job in many.jobs}
    assert len(many.jobs) == 12


def test_a_repeat_is_a_run_of_its_own(tmp_path: Path) -> None:
    once, plan = plan_in(tmp_path, seeds=2), plan_in(tmp_path, seeds=2, repeats=2)
    assert [(job.seed, job.repeat) for job in plan.jobs] == [(3, 1), (3, 2), (4, 1), (4, 2)]
    assert [job.id for job in plan.jobs[::2]] == [job.id for job in once.jobs]
    assert len({job.id for job in plan.jobs}) == len({job.out for job in plan.jobs}) == 4
    assert plan.jobs[0].text == plan.jobs[1].text
    assert [str(job) for job in plan.jobs[:2]] == ["seed=3", "seed=3 repeat=2"]
    with pytest.raises(ConfigError, match="--repeat: expected at least 1, found 0"):
        plan_in(tmp_path, repeats=0)


def test_runs_with_equal_flights_record_them(tmp_path: Path) -> None:
    config = flight_file(tmp_path)
    jobs = make_plan(config, ["craft.rate=10,20", "guesser.latency=1ms,2ms"], out=tmp_path).jobs
    flights = [job.flight for job in jobs]
    assert all(job.record for job in jobs)
    assert flights[0] == flights[1] != flights[2] == flights[3]
    alone = make_plan(config, ["craft.rate=10,20"], out=tmp_path).jobs
    assert [(job.flight, job.record) for job in alone] == [(f, False) for f in flights[::2]]
    assert [job.id for job in make_plan(config, ["craft.rate=10,20"], fly=True).jobs] == [
        job.id for job in alone
    ]
    (job,) = make_plan(config, fly=True, limit=7.0).jobs
    assert (job.flight, job.record, job.limit) == ("", False, 7.0)
    assert alone[0].limit == 600 + 3 * 30


def test_without_parameters_there_are_just_seeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plan = make_plan(judge_file(tmp_path), seeds=3)
    assert [job.seed for job in plan.jobs] == [3, 4, 5]
    assert plan.out == tmp_path / "sweeps" / "judged"


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        (["judge.rate=5,fast"], "with judge.rate=fast: judge.toml: nodes[0] (judge): rate: exp"),
        (["judge.rte=5"], "(did you mean 'rate'?)"),
        (["run.seed=1,2"], "--vary run.seed: expected --seeds N"),
        (["judge.rate=1", "judge.rate=2"], "--vary judge.rate: expected each path once"),
        (["judge.limit=1"], "--vary judge.limit: expected a path without --set, found both"),
        (["judge.rate=5,5.0"], "same settings for judge.rate=5 seed=3 and judge.rate=5.0 seed=3"),
    ],
)
def test_mistakes_are_found_before_anything_runs(
    tmp_path: Path, vary: list[str], message: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        plan_in(tmp_path, *vary, overrides=["judge.limit=50"])
    assert message in str(caught.value)
    assert not (tmp_path / "out").exists()
