"""`featuredb candidates`: the inbox of contributed photos, and the withdrawal of some of them."""

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from featuredb.cli.common import add_command, format_table, open_database, write_json
from featuredb.errors import CandidateNotFoundError, InvalidValueError
from featuredb.store.candidates.states import ANONYMOUS, CANDIDATE_STATES, Candidate

_SHOWN_ID = 12  # hex digits of an id in a table: enough to tell some millions of photos apart
_SHORTEST_ID = 8


def register(subparsers: Any) -> None:
    parser = add_command(
        subparsers,
        "candidates",
        run_candidates,
        "list contributed photos, or withdraw some",
        description="List the photos that clients contributed: waiting for growth, used by a map, refused "
        "or withdrawn. With --withdraw, --withdraw-owner or --withdraw-credit their images are deleted, at "
        "once and for good.",
    )
    parser.add_argument("--state", choices=CANDIDATE_STATES, help="only those in this state")
    parser.add_argument(
        "--owner",
        metavar="IDENTITY",
        help=f"only those of this client; {ANONYMOUS}: of all without a certificate",
    )
    parser.add_argument("--credit", metavar="NAME", help="only those with which this name was given")
    parser.add_argument("--json", action="store_true", help="everything that is known, as JSON")
    parser.add_argument(
        "--withdraw",
        metavar="ID",
        action="append",
        default=[],
        help="delete the image of this photo, by its id or the beginning of it; may be repeated",
    )
    parser.add_argument(
        "--withdraw-owner", metavar="IDENTITY", help="delete all images that this client gave"
    )
    parser.add_argument(
        "--withdraw-credit", metavar="NAME", help="delete all images with which this name was given"
    )
    parser.add_argument("--reason", default="", help="kept with a withdrawal, which needs one")


def run_candidates(args: argparse.Namespace) -> None:
    from featuredb.store.candidates.photos import list_candidates, withdraw

    database = open_database(args)
    candidates = list_candidates(database)
    if args.withdraw or args.withdraw_owner or args.withdraw_credit:
        wanted = _to_withdraw(candidates, args.withdraw, args.withdraw_owner, args.withdraw_credit)
        if not args.reason.strip():
            raise InvalidValueError("expected --reason with a withdrawal, for those who will ask later")
        report = withdraw(database, wanted, args.reason)
        sys.stdout.write(f"withdrawn: {len(report.candidates)} photos, {len(report.files)} files deleted\n")
        if report.used_by:
            sys.stdout.write(
                f"maps {', '.join(report.used_by)} were built with them and keep their features (no pixels); "
                "`featuredb retire` removes a map\n"
            )
        return
    shown = [
        c
        for c in candidates
        if (args.state is None or c.state == args.state) and _given_by(c, args.owner, args.credit)
    ]
    if args.json:
        write_json({"candidates": [asdict(c) for c in shown]})
        return
    counts = Counter(c.state for c in candidates)
    sys.stdout.write(", ".join(f"{counts[state]} {state}" for state in CANDIDATE_STATES) + "\n")
    if shown:
        header = ("candidate", "state", "owner", "credit", "licence", "received", "answer", "kB", "about")
        shown.sort(key=lambda c: CANDIDATE_STATES.index(c.state))  # stable: oldest first within a state
        sys.stdout.write("\n" + format_table(header, map(_row, shown)))


def _given_by(candidate: Candidate, owner: str | None, credit: str | None) -> bool:
    """Whether one of those who gave the photo is that owner, and goes by that name; None: anybody."""
    return any(owner in (None, c.owner) and credit in (None, c.credit) for c in candidate.contributors)


def _to_withdraw(
    candidates: Sequence[Candidate], beginnings: Sequence[str], owner: str | None, credit: str | None
) -> list[str]:
    wanted = []
    for beginning in beginnings:
        found = [c.candidate_id for c in candidates if c.candidate_id.startswith(beginning)]
        if len(beginning) < _SHORTEST_ID or len(found) != 1:
            raise CandidateNotFoundError(
                f"expected at least {_SHORTEST_ID} digits of the id of one photo, found {beginning!r}, which "
                f"{len(found)} photos begin with; `featuredb candidates` lists them"
            )
        wanted += found
    if owner is not None or credit is not None:
        theirs = [c.candidate_id for c in candidates if _given_by(c, owner, credit)]
        if not theirs:
            who = " and ".join(
                f"{what} {name!r}"
                for what, name in (("owner", owner), ("credit", credit))
                if name is not None
            )
            raise CandidateNotFoundError(f"no photo of {who}; `featuredb candidates` lists them")
        wanted += theirs
    return wanted


def _row(candidate: Candidate) -> tuple[object, ...]:
    about = candidate.reason and f"{candidate.reason_code}: {candidate.reason}".removeprefix(": ")
    others = [giver.owner for giver in candidate.contributors[1:]]
    if candidate.used_by:
        about = f"used by {', '.join(candidate.used_by)}"
    if others:
        about = f"{about}; also given by {', '.join(others)}".removeprefix("; ")
    return (
        candidate.candidate_id[:_SHOWN_ID],
        candidate.state,
        candidate.owner,
        candidate.credit,
        candidate.licence,
        candidate.received_at,
        str(candidate.answer.get("status", "")),
        round(candidate.size_bytes / 1000),
        about,
    )
