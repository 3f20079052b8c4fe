"""What a careful colleague would say about a file, by rules that packages offer.

A package names its rules in its ``pyproject.toml``; this project does the same for its own:

    [project.entry-points."visnav.lint"]
    my_package = "my_package.rules:RULES"       # a list of functions

A rule is a function of the settings and of what the nodes announced, which yields a `Finding` for
each thing that is odd; its name, with hyphens, is the rule's, and its docstring says why it is one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence

import msgspec

from events import Announcement
from runtime.config.model import Config
from runtime.errors import suggest
from runtime.tools.plugins import offers

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
