"""A sweep: a file run with many settings and seeds, each run in a separate process.

    config.toml, --vary, --seeds, --repeat → Plan of Jobs → Executor → Rows → tables and plots

Read in this order: `plan` (what ``--vary`` says, and which runs there are), `process` (one run),
`tables` (what is remembered of it, and the result), `console` (all runs, and what a terminal shows
meanwhile), `plots` (and the page). The command itself is `runtime.tools.cli.sweep`.

The executor may be any of `concurrent.futures`, also one that spreads the runs over machines on
which the project is installed. With Dask (``pip install distributed``)::

    plan = make_plan(Path("config.toml"), ["camera.rate=5,10,20"], seeds=3)
    with Client("tcp://scheduler:8786") as client:  # from dask.distributed
        rows = sweep(plan, client.get_executor(pure=False))
    write_tables(plan, rows)
    draw_plots(plan, rows)
    write_page(plan, rows)

Runs that differ only in what comes after the sensors use one flight, which each machine records
once (`runtime.tools.flights`). ``pure=False`` lets a failed run be tried again. A job carries its
settings as text; what it reads besides (modules beside the file, trajectories, worlds) must be
found at the same paths on every machine, with the same content, or the next call runs the job again
(`runtime.run.made_from`). A run's folder of results stays on the machine that ran it unless the
sweep's folder is shared. The rows come back in any case.
"""

from runtime.tools.sweep.console import Watch, run_here, sweep
from runtime.tools.sweep.plan import Job, Plan, make_job, make_plan, plan_of
from runtime.tools.sweep.plots import draw_plots, write_page
from runtime.tools.sweep.process import Children, run_job
from runtime.tools.sweep.tables import Row, records, summarise, write_tables

__all__ = [
    "Children", "Job", "Plan", "Row", "Watch", "draw_plots", "make_job", "make_plan", "plan_of",
    "records", "run_here", "run_job", "summarise", "sweep", "write_page", "write_tables",
]  # fmt: skip
