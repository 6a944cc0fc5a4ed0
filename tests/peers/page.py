"""The report in a real browser: no errors, a cloud that is drawn, heights under the pointer as GDAL reads them."""

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import numpy as np
import rasterio

from common import Barchan, Table

BROWSERS = ("chromium", "chromium-browser", "google-chrome")

WATCH = """<script>
window.faults = [];
addEventListener("error", (e) => faults.push(String(e.message)));
addEventListener("securitypolicyviolation", (e) => faults.push("blocked: " + e.blockedURI));
console.error = (...said) => faults.push(said.join(" "));
</script>"""

ASK = """<script>
setTimeout(() => {
  const cloud = document.getElementById("cloud"), gl = cloud.getContext("webgl");
  const pixels = new Uint8Array(4 * cloud.width * cloud.height);
  gl.readPixels(0, 0, cloud.width, cloud.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  let drawn = 0;
  for (let k = 0; k < pixels.length; k += 4) drawn += pixels[k] > 60;
  const relief = document.getElementById("relief"), box = relief.getBoundingClientRect();
  const heard = %s.map(([column, row]) => {
    const clientX = box.left + ((column + 0.5) / relief.width) * box.width;
    const clientY = box.top + ((row + 0.5) / relief.height) * box.height;
    relief.dispatchEvent(new PointerEvent("pointermove", { clientX, clientY }));
    return document.getElementById("relief-note").textContent;
  });
  const answer = document.createElement("pre");
  answer.id = "answer";
  answer.textContent = JSON.stringify({ faults, drawn: drawn / (cloud.width * cloud.height), heard });
  document.body.append(answer);
}, 3000);
</script>"""


def check(table: Table, barchan: Barchan, run: Path, map_dir: Path, work: Path) -> None:
    """The page of a run, opened and asked."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        print("skipped: the report in a browser (no chromium on the path)")
        return
    page = work / "report.html"
    barchan("report", run, "--map", map_dir, "--out", page)
    with rasterio.open(map_dir / "dem.tif") as dem:
        heights = dem.read(1, masked=True).filled(np.nan)
        places = {}
        for row, column in np.argwhere(np.isfinite(heights))[:: max(1, np.isfinite(heights).sum() // 20)]:
            places[int(column), int(row)] = (*dem.xy(row, column), heights[row, column])

    html = page.read_text()
    cells = [list(cell) for cell in places]
    html = html.replace("<head>", "<head>" + WATCH, 1).replace("</body>", ASK % json.dumps(cells) + "</body>")
    asked = work / "asked.html"
    asked.write_text(html)
    software = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    words = [browser, "--headless=new", "--no-sandbox", *software, "--virtual-time-budget=20000", "--dump-dom"]
    dom = subprocess.run([*words, asked.as_uri()], capture_output=True, text=True, timeout=300).stdout
    answer = json.loads(unescape(re.search(r'<pre id="answer">(.*?)</pre>', dom, re.DOTALL)[1]))

    table.equal("report in a browser: errors", len(answer["faults"]), 0)
    for fault in answer["faults"]:
        print(f"  {fault}")
    table.at_least("report in a browser: share of the cloud's canvas that is drawn", answer["drawn"], 0.05)
    off = [
        np.abs(np.subtract([float(v) for v in re.findall(r"-?\d+\.\d+", said)[:3]], truth)).max()
        for said, truth in zip(answer["heard"], places.values())
    ]
    table.at_least("report in a browser: cells asked for their height", len(off), 10)
    # Places are told to a centimetre.
    table.at_most("report in a browser: place and height under the pointer, m", max(off), 0.0051)
