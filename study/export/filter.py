"""The filter of a configuration as C99 for flight software, see `rta.fast.files`, with what was verified of it."""

import shlex
from pathlib import Path

from kernels.exported import check_prefix
from rta.fast.files import NAME, NOT_VERIFIED, write
from study.config import Config
from study.errors import as_input_error
from study.experiment import check_chief, checked_filter
from study.verified import (
    Flown,
    alike,
    fingerprint,
    relevant,
    reports,
    settings_digest,
    shown,
    unchecked,
    verified,
)


def export(config: Config, directory: Path, prefix: str = NAME) -> str:
    """Writes the filter of a configuration into a directory, which may hold an older one; returns a message about it.

    Args:
        prefix: as in `rta.fast.files.write`.

    Raises:
        InputError: the configuration cannot be used, the directory holds other files, or it cannot be written.
    """
    with as_input_error("--prefix", ValueError):
        check_prefix(prefix)
    check_chief(config)
    safety_filter = checked_filter(config)
    said = said_of(config)
    with as_input_error(f"--filter {directory}: cannot write there", OSError, ValueError):
        texts = write(safety_filter, directory, said, settings_digest(config), prefix)
    lines = texts[f"{prefix}.c"].count("\n")
    test = shlex.join(["make", "-C", str(directory), "test"])
    return f"{directory}: {', '.join(texts)}; {lines:,} lines\n{said}\nNext:\n  {test}"


def said_of(config: Config) -> str:
    """Returns what the filter of a configuration does not check, which campaigns have flown it, and their results."""
    own = fingerprint(config)
    same = alike(relevant(config), list(reports(("python", "c"))))
    missing = unchecked(config)
    lines = [missing] if missing else []
    lines += [of_campaign(each) for each in same if each.large or not each.clean]
    if not all(each.clean for each in same):
        first = f"NOT VERIFIED: campaigns broke this filter (fingerprint {own})."
    elif verified(same):
        first = (
            f"Verified (fingerprint {own}) by campaigns under random and adversarial controls. "
            "docs/results/safety.md says what breaks a filter, docs/reference/proof.md what of its check is not proven."
        )
    else:
        first = NOT_VERIFIED.replace("this filter", f"this filter (fingerprint {own}) enough")
    return "\n".join([first, *lines])


def of_campaign(flown: Flown) -> str:
    """Describes a campaign in a line."""
    report, campaign = flown.report, flown.report["campaign"]
    form = {"python": "in Python", "c": "in C"}
    starts = " next to limits" if campaign.get("starts") == "limits" else ""
    return (
        f"  {shown(flown.path)}: {campaign['policy']}, {report['episodes']:,} episodes of {campaign['duration']:,} s"
        f"{starts} {form[campaign.get('filter', 'python')]}, {flown.violating:,} with a violation, "
        f"{report['unsolved']:,} calls unsolved"
    )
