"""The simulated motor behind an OPC UA server or as a client of an MQTT broker, in a process of its own."""

import asyncio
import json
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from asyncua import Server, ua
from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

from otolith_drivers.plant.realtime import NodeSummary, in_real_time
from otolith_drivers.plant.scenario import load_scenario


def measured(scenario: Path) -> Iterator[tuple[float, dict[str, float]]]:
    """The Unix time (s) and the measured values of each sample, when it is taken."""
    for _, scheduled in in_real_time(load_scenario(scenario), {"can": NodeSummary.of(())}, lambda: False):
        yield time.time() - time.monotonic() + scheduled.taken, dict(scheduled.sample.measured)


async def serve(port: int, scenario: Path) -> None:
    server = Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/motor")
    space, nodes = await server.register_namespace("urn:motor"), {}
    samples = measured(scenario)
    for name in (await asyncio.to_thread(next, samples))[1]:
        nodes[name] = await server.nodes.objects.add_variable(ua.NodeId(name, space), name, 0.0)
    async with server:
        while True:
            moment, values = await asyncio.to_thread(next, samples)
            stamp = datetime.fromtimestamp(moment, UTC)
            for name, value in values.items():
                new = ua.DataValue(ua.Variant(float(value)), SourceTimestamp=stamp, ServerTimestamp=stamp)
                await server.write_attribute_value(nodes[name].nodeid, new)


def publish(port: int, scenario: Path) -> None:
    client = mqtt.Client(CallbackAPIVersion.VERSION2)
    client.connect("127.0.0.1", port)
    client.loop_start()
    for moment, values in measured(scenario):
        client.publish("motor", json.dumps({"t": 1e3 * moment, "values": values}))


if __name__ == "__main__":
    door, port, scenario = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
    if door == "opcua":
        asyncio.run(serve(port, scenario))
    else:
        publish(port, scenario)
