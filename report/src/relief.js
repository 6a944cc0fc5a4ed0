"use strict";
// A picture of heights, and the height under the pointer.
(() => {
  const canvas = document.getElementById("relief");
  const note = document.getElementById("relief-note");
  const data = JSON.parse(document.getElementById("relief-data").textContent);
  const floats = (text) => new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
  const elevation = floats(data.elevation);
  const bound = data.bound && floats(data.bound);
  [canvas.width, canvas.height] = [data.width, data.height];
  canvas.style.maxWidth = `min(100%, ${Math.round((700 * data.width * data.cell[0]) / (data.height * data.cell[1]))}px)`;
  canvas.style.aspectRatio = `${data.width * data.cell[0]} / ${data.height * data.cell[1]}`;
  const picture = new Image();
  picture.onload = () => canvas.getContext("2d").drawImage(picture, 0, 0);
  picture.src = data.picture;
  canvas.addEventListener("pointermove", (e) => {
    const box = canvas.getBoundingClientRect();
    const column = Math.floor(((e.clientX - box.left) / box.width) * data.width);
    const row = Math.floor(((e.clientY - box.top) / box.height) * data.height);
    if (column < 0 || row < 0 || column >= data.width || row >= data.height) return;
    const [x, y] = [data.west + (column + 0.5) * data.cell[0], data.north - (row + 0.5) * data.cell[1]];
    const z = elevation[row * data.width + column];
    const half = bound ? bound[row * data.width + column] : NaN;
    const height = Number.isNaN(z) ? "unknown" : `${z.toFixed(3)} m` + (Number.isNaN(half) ? "" : ` ± ${half.toFixed(3)} m (3 sigma)`);
    note.textContent = `x ${x.toFixed(2)} m, y ${y.toFixed(2)} m: height ${height}`;
  });
})();
