#!/usr/bin/env python3
"""Load for `barchan serve`: pairs at a steady rate, there and back along a rendered drive.

    load.py BARCHAN [--model rover] [--size 484 366] [--rate 10] [--seconds 600] [--pairs COUNT] [--config FILE]

Sends each pair when it is due, whether or not the one before is answered, and says what was answered, how fast,
and what the service has of memory on the way. Exits with 1 when an answer was lost. --rate 0 sends one after the
other as fast as they are answered.
"""

import argparse
import http.client
import json
import queue
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

FRAMES = 40
SENDERS = 8


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("barchan", type=Path)
    parser.add_argument("--model", default="rover")
    parser.add_argument("--size", type=int, nargs=2, default=(484, 366), metavar=("W", "H"))
    parser.add_argument("--rate", type=float, default=10)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--pairs", type=int, help="instead of --seconds")
    parser.add_argument("--config", type=Path, help="settings of the service")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        sys.exit(measure(options, Path(folder)))


def measure(options, folder):
    data = folder / "data"
    width, height = options.size
    spec = f"synth:seed=5,frames={FRAMES},width={width},height={height}"
    subprocess.run([options.barchan, "data", "synth", spec, "--out", data], check=True, stdout=subprocess.DEVNULL)
    bodies = [form(data, i) for i in range(FRAMES)]
    command = [options.barchan, "serve", "--json", "--listen", "127.0.0.1:0", "--model", options.model]
    command += ["--rig", data / "rig.toml", "--runs", folder / "runs", "--keep-runs", "2", "--max-rate", "10000"]
    if options.config:
        command += ["--config", options.config]
    service = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    said = ""
    while not said.endswith("}\n"):
        said += service.stdout.readline()
    address = json.loads(said)["listening"]
    try:
        return send(options, service, address, bodies)
    finally:
        service.terminate()
        service.wait(timeout=120)


def form(data, i):
    parts = []
    for side in ("left", "right"):
        image = (data / side / f"{i:06d}.png").read_bytes()
        parts.append(f'--cut\r\nContent-Disposition: form-data; name="{side}"\r\n\r\n'.encode() + image)
    return b"\r\n".join(parts) + b"\r\n--cut--\r\n"


def send(options, service, address, bodies):
    count = options.pairs or round(options.rate * options.seconds)
    # There and back: the camera never jumps.
    way = list(range(FRAMES)) + list(range(FRAMES - 2, 0, -1))
    due, answers, memory = queue.Queue(), [], []

    def sender():
        connection = http.client.HTTPConnection(address, timeout=120)
        headers = {"Content-Type": "multipart/form-data; boundary=cut"}
        while (job := due.get()) is not None:
            number, at = job
            try:
                connection.request("POST", "/pairs", bodies[way[number % len(way)]], headers)
                response = connection.getresponse()
                told = json.loads(response.read())
                tracked = bool(told.get("track", {}).get("tracked"))
                answers.append((response.status, 1e3 * (time.monotonic() - at), tracked))
            except (OSError, http.client.HTTPException, ValueError) as error:
                answers.append((str(error), 0.0, False))
                connection.close()

    senders = [threading.Thread(target=sender) for _ in range(SENDERS if options.rate else 1)]
    for thread in senders:
        thread.start()
    begun = time.monotonic()
    marks = {round(count * k / 10) for k in range(1, 11)} | {min(200, count)}
    for number in range(count):
        if options.rate:
            time.sleep(max(0.0, begun + number / options.rate - time.monotonic()))
        elif due.qsize() > 1:
            while due.qsize() > 1:
                time.sleep(0.001)
        due.put((number, time.monotonic()))
        if number + 1 in marks:
            memory.append((number + 1, resident(service.pid)))
            print(f"{number + 1} pairs sent, {len(answers)} answered, {memory[-1][1]:.0f} MB resident", flush=True)
    for _ in senders:
        due.put(None)
    for thread in senders:
        thread.join()
    seconds = time.monotonic() - begun

    good = sorted(ms for status, ms, _ in answers if status == 200)
    lost = count - len(good)
    tracked = sum(t for *_, t in answers)
    print(f"{count} pairs in {seconds:.0f} s ({count / seconds:.1f} a second), {lost} lost, {tracked} tracked")
    if good:
        p95 = good[min(len(good) - 1, round(0.95 * len(good)))]
        print(f"from due to answered: median {statistics.median(good):.0f} ms, p95 {p95:.0f} ms, longest {good[-1]:.0f} ms")
    for status in {s for s, *_ in answers if s != 200}:
        print(f"not answered: {status}")
    print(f"memory: {memory[0][1]:.0f} MB after {memory[0][0]} pairs, {memory[-1][1]:.0f} MB at the end")
    return 1 if lost else 0


def resident(process):
    """MB of a process."""
    status = Path(f"/proc/{process}/status").read_text()
    return int(re.search(r"^VmRSS:\s+(\d+)", status, re.MULTILINE)[1]) * 1.024e-3


if __name__ == "__main__":
    main()
