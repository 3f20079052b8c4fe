"""What a careful colleague would say about a file, by rules that packages offer.

A package names its rules in its ``pyproject.toml``; this project does the same for its own:

    [project.entry-points."visnav.lint"]
    my_package = "my_package.rules:RULES"       # a list of functions

A rule is a function of the settings and of what the nodes announced, which yields a `Finding` for
each thing that is odd; its name, with hyphens, is the rule's, and its docstring says why it is one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

import msgspec

from events import Announcement, EstimatorAnnouncement, Shutdown, WindowClosed
from runtime.config.model import Config, NodeSpec
from runtime.config.plugins import offers
from runtime.errors import suggest
from runtime.run.graph import edges
from runtime.tools.preflight import mentioned_in

GROUP = "visnav.lint"


class Finding(msgspec.Struct, frozen=True):
    """Something odd.

    Attributes:
        subject: Source of the sensor, or name of the node.
        found: What is odd about it.
        change: What to change, if it is not meant.
        rule: Name of the rule.
    """

    subject: str
    found: str
    change: str
    rule: str = ""

    def __str__(self) -> str:
        return f"{self.rule}: {self.subject}: {self.found}: {self.change}"


Rule = Callable[[Config, Sequence[Announcement]], Iterable[Finding]]


def rules() -> dict[str, Rule]:
    """Return all rules by name.

    Raises:
        CommandError: Those of a package cannot be imported.
    """
    found: list[Rule] = [rule for offer in offers(GROUP) for rule in offer.load()]
    return {rule.__name__.replace("_", "-"): rule for rule in found}


def lint(
    config: Config, announcements: Sequence[Announcement], ignore: Collection[str] = ()
) -> list[Finding]:
    """Return what is odd about a file, but for what it accepts itself.

    Args:
        config: The file.
        announcements: What its nodes announced.
        ignore: Names of rules that are left out, or ``rule:subject``.
    """
    known = rules()
    accepted = {*config.run.accept, *ignore}
    found = [
        Finding(
            "run", f"accept names no rule: {name}", f"take it out{suggest(name, known)}", "accept"
        )
        for name in sorted(accepted)
        if name.partition(":")[0] not in known
    ]
    for name, rule in known.items():
        if name not in accepted:
            each = (msgspec.structs.replace(one, rule=name) for one in rule(config, announcements))
            found += [one for one in each if f"{name}:{one.subject}" not in accepted]
    return found


def no_end(config: Config, announced: Sequence[Announcement]) -> Iterator[Finding]:  # noqa: ARG001
    """Nothing but Ctrl-C ends a run without a duration, a pilot or a replay."""
    if not config.run.duration and not any(map(_may_end, config.nodes)):
        found = "it has no duration, and no node that ends it, as a pilot or a replay does"
        yield Finding("run", found, "give it a duration")


def idle(config: Config, announced: Sequence[Announcement]) -> Iterator[Finding]:  # noqa: ARG001
    """Without anybody who sends it orders, a vehicle stands still."""
    heard = {receiver for *_, receiver, _ in edges([(s.name, s.node) for s in config.nodes])}
    for spec in config.nodes:
        handlers = spec.node.declared.handlers
        only = handlers and len(handlers) == len(spec.node.declared.listening)
        if only and spec.name not in heard and not _may_end(spec):
            events = dict.fromkeys(e.__name__ for h in handlers.values() for e in h.events)
            found = f"it waits for {' or '.join(events)}, which no node sends"
            yield Finding(spec.name, found, "add one that does")


def nobody_judged(config: Config, announced: Sequence[Announcement]) -> Iterator[Finding]:
    """Who judges wants an estimator."""
    sent = edges([(spec.name, spec.node) for spec in config.nodes])
    judged = {receiver for *_, receiver, port in sent if port == "estimates"}
    for spec in config.nodes:
        if "thresholds" in spec.config.__struct_fields__ and not (
            spec.name in judged or any(isinstance(a, EstimatorAnnouncement) for a in announced)
        ):
            yield Finding(spec.name, "nobody sends estimates that it could judge", "add one")


RULES: list[Rule] = [no_end, idle, nobody_judged]


def _may_end(spec: NodeSpec) -> bool:
    """Return whether a node may end the run."""
    sends = (output.event for output in spec.node.declared.outputs.values())
    ends = "stop" in mentioned_in(spec.node) or any(
        issubclass(event, Shutdown | WindowClosed) for event in sends
    )
    return ends and bool(getattr(spec.config, "end_run", True))
