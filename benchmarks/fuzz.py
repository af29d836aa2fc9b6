"""What gets through the boundaries: ``python benchmarks/fuzz.py [--messages N] [--quick] [--json FILE]``.

Throws seeded mutations of one good sample at the decoder of every topic (and of the two queries), at the scenario
loader and at the log reader. Anything but the boundary's own error is a crash; whatever passes is judged again by
``mutations.garbage_in``, which shares nothing with the codec. Memory is this process' resident set.
Status 1 when there was a crash or accepted garbage.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import msgspec
import psutil
from chaserdock_protocol import codec, topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import JoinReply, JoinRequest
from chaserdock_protocol.recording.log import LogError, read_log, read_scenario
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.scenario.errors import ScenarioError
from mutations import garbage_in, mutate, value_mutator
from results import options_of, write_json

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))


@dataclass
class Outcome:
    """How many of what was thrown were refused and accepted; each crash and garbage with what caused it."""

    thrown: int = 0
    accepted: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    crashes: list[str] = field(default_factory=list)
    garbage: list[str] = field(default_factory=list)


def boundaries() -> dict[str, type[msgspec.Struct]]:
    """Every key that messages come in by, and the type it carries."""
    found = {topic.key: topic.kind for topic in topics.TOPICS}
    return found | {f"{topics.JOIN_KEY} (query)": JoinRequest, f"{topics.JOIN_KEY} (reply)": JoinReply}


def fuzz_messages(kind: type[msgspec.Struct], number: int, seed: int) -> Outcome:
    """``number`` mutated messages at the decoder of ``kind``."""
    from message_samples import BY_TYPE

    out = Outcome(thrown=number)
    rng = random.Random(f"{seed}/{kind.__name__}")
    sample = codec.encode(BY_TYPE[kind])
    by_value = value_mutator(sample)
    for _ in range(number):
        payload = by_value(rng) if rng.random() < 0.3 else mutate(sample, rng)
        try:
            message = codec.decode(kind, payload)
        except Rejected as refusal:
            out.refused[refusal.reason] += 1
            continue
        except Exception as error:
            out.crashes.append(f"{type(error).__name__}: {error}: {payload[:200].hex()}")
            continue
        out.accepted += 1
        wrong = garbage_in(message)
        if wrong is not None:
            out.garbage.append(f"{wrong}: {payload[:200].hex()}")
    return out


def fuzz_scenarios(number: int, seed: int) -> Outcome:
    """``number`` mutated scenario files at the loader; one that passes has to survive being told to the others."""
    out, rng = Outcome(thrown=number), random.Random(f"{seed}/scenarios")
    texts = [path.read_bytes() for path in sorted((ROOT / "scenarios").glob("*.toml"))]
    values = (
        b"nan",
        b"inf",
        b"-1",
        b"0",
        b"1e308",
        b"[]",
        b'""',
        b"{}",
        b"true",
        b"99999999999999999999",
        b"[" * 2000,
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mutated.toml"
        for _ in range(number):
            text = texts[int(rng.random() * len(texts))]
            if rng.random() < 0.7:  # a whole value, so that it is TOML still
                lines = text.split(b"\n")
                places = [k for k, line in enumerate(lines) if b" = " in line]
                at = places[int(rng.random() * len(places))]
                key = lines[at].partition(b" = ")[0]
                lines[at] = key + b" = " + values[int(rng.random() * len(values))]
                text = b"\n".join(lines)
            else:
                text = mutate(text, rng)
            path.write_bytes(text)
            try:
                scenario = load_scenario(path)
                text_of = scenario.model_dump_json()
                if type(scenario).model_validate_json(text_of).model_dump_json() != text_of:
                    out.garbage.append(f"not the same after a round trip: {text[:200]!r}")
                out.accepted += 1
            except ScenarioError as refusal:
                out.refused["ScenarioError"] += 1
                if len(str(refusal)) > 20_000:
                    out.garbage.append(f"an error of {len(str(refusal))} characters")
            except Exception as error:
                out.crashes.append(f"{type(error).__name__}: {error}: {text[:200]!r}")
    return out


def fuzz_logs(number: int, seed: int) -> Outcome:
    """``number`` mutated logs at the reader; of those that it reads, every message is judged again."""
    out, rng = Outcome(thrown=number), random.Random(f"{seed}/logs")
    good = (ROOT / "tests" / "golden" / "two-chasers.mcap").read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mutated.mcap"
        for _ in range(number):
            data = mutate(good, rng)
            path.write_bytes(data)
            try:
                rejected: Counter[str] = Counter()
                for record in read_log(path, rejected=rejected):
                    wrong = garbage_in(record.message)
                    if wrong is not None:
                        out.garbage.append(wrong)
                read_scenario(path)
                out.accepted += 1
            except LogError:
                out.refused["LogError"] += 1
            except Exception as error:
                out.crashes.append(f"{type(error).__name__}: {error}")
    return out


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000, help="mutated messages a topic")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    number = 20_000 if options.quick else options.messages
    process = psutil.Process()
    figures: dict[str, float] = {}
    bad = 0
    runs: dict[str, Callable[[], Outcome]] = {
        name: partial(fuzz_messages, kind, number, options.seed) for name, kind in boundaries().items()
    }
    runs["scenario loader"] = partial(fuzz_scenarios, max(200, number // 50), options.seed)
    runs["log reader"] = partial(fuzz_logs, max(50, number // 500), options.seed)
    garbage_in(next(iter(_samples())))  # what is loaded once is loaded before memory is measured
    first_mb = process.memory_info().rss / 1e6
    for name, run in runs.items():
        begun_s, before_mb = time.monotonic(), process.memory_info().rss / 1e6
        out = run()
        after_mb = process.memory_info().rss / 1e6
        refused = " ".join(f"{reason} {count}" for reason, count in sorted(out.refused.items()))
        print(
            f"{name:36} {out.thrown:8} thrown, {out.accepted:7} passed, {len(out.crashes)} crashes, {len(out.garbage)} "
            f"garbage; {before_mb:.0f} -> {after_mb:.0f} MB; {time.monotonic() - begun_s:.0f} s; {refused}",
            flush=True,
        )
        for line in (out.crashes + out.garbage)[:5]:
            print(f"    {line[:400]}")
        bad += len(out.crashes) + len(out.garbage)
        figures[f"{name}: thrown"], figures[f"{name}: passed"] = out.thrown, out.accepted
        figures[f"{name}: grown_MB"] = after_mb - before_mb
    figures |= {"crashes_and_garbage": bad, "memory_before_MB": first_mb}
    figures["memory_after_MB"] = process.memory_info().rss / 1e6
    print(f"memory {first_mb:.0f} -> {figures['memory_after_MB']:.0f} MB; {bad} crashes and garbage")
    write_json(options.json, figures)
    sys.exit(1 if bad else 0)


def _samples() -> tuple[msgspec.Struct, ...]:
    from message_samples import SAMPLES

    return SAMPLES


if __name__ == "__main__":
    main()
