"""A client of Zenoh that publishes what it must not, in a process and, if it is root, as a user of its own.

Its argument is a JSON object: ``connect``, ``settings``, ``uid``, and ``opening`` and ``answering`` (s): how long it
waits for a session and for an answer, if not briefly. It prints ``refused`` if no session opens. Otherwise it
attacks, prints ``attacked``, waits for the end of its standard input, and prints what it has received.
"""

import json
import os
import sys
import threading  # noqa: F401 - Zenoh imports it later, when the user may not read Python's library any more

import zenoh

FORGED = "forged"
KEY = "otolith/s/m/report"
GHOST = "otolith/here/ghost"
BRIEFLY = 2.0  # s: a session that is accepted opens in some 10 ms, and its query is answered at once


def main() -> None:
    given = json.loads(sys.argv[1])
    if given.get("uid"):
        os.setgroups([])
        os.setgid(given["uid"])
        os.setuid(given["uid"])
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "connect/endpoints": [given["connect"]],
        "connect/timeout_ms": round(1000 * given.get("opening", BRIEFLY)),
        "scouting/multicast/enabled": False,
        **given.get("settings", {}),
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        sys.stdout.write("refused\n")
        return
    received: list[str] = []
    with session:
        session.declare_subscriber(
            "otolith/**",
            lambda sample: received.append(sample.payload.to_string()),
            allowed_origin=zenoh.Locality.REMOTE,
        )
        ghost = session.liveliness().declare_token(f"{GHOST}/alive")
        queryable = session.declare_queryable(KEY, lambda query: query.reply(KEY, FORGED), complete=True)
        for key in (KEY, f"{GHOST}/report", "otolith/s/m/event"):
            session.put(key, FORGED)
            session.delete(key)
        sys.stdout.write("attacked\n")
        sys.stdout.flush()
        sys.stdin.read()
        # A subscription may arrive after the reports of the test; a query waits for its answer.
        replies = session.get(KEY, target=zenoh.QueryTarget.ALL, timeout=given.get("answering", BRIEFLY))
        answers = [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]
        received += [answer for answer in answers if answer != FORGED]  # its own queryable answers as well
        del ghost, queryable
    sys.stdout.write(json.dumps(received) + "\n")


if __name__ == "__main__":
    main()
