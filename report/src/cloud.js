"use strict";
// A cloud of points and the way of the camera, turned about the point that is looked at; z is up.
(() => {
  const canvas = document.getElementById("cloud");
  const note = document.getElementById("cloud-note");
  const data = JSON.parse(document.getElementById("cloud-data").textContent);
  const gl = canvas.getContext("webgl", { antialias: true, preserveDrawingBuffer: true });
  if (!gl) {
    note.textContent = "This browser has no WebGL: open cloud.ply in CloudCompare or MeshLab instead.";
    return;
  }
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const positions = new Uint16Array(bytes(data.positions).buffer);
  const colours = bytes(data.colours);
  const route = new Uint16Array(bytes(data.route).buffer);

  const program = gl.createProgram();
  const shader = (kind, text) => {
    const made = gl.createShader(kind);
    gl.shaderSource(made, text);
    gl.compileShader(made);
    gl.attachShader(program, made);
  };
  shader(gl.VERTEX_SHADER, `
    attribute vec3 place; attribute vec3 colour; varying vec3 tint;
    uniform mat4 view; uniform float size; uniform vec4 paint;
    void main() {
      gl_Position = view * vec4(place, 1.0);
      gl_PointSize = clamp(size / gl_Position.w, 1.0, 12.0);
      tint = mix(colour, paint.rgb, paint.a);
    }`);
  shader(gl.FRAGMENT_SHADER, "precision mediump float; varying vec3 tint; void main() { gl_FragColor = vec4(tint, 1.0); }");
  gl.linkProgram(program);
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(0.08, 0.085, 0.1, 1);
  const buffer = (values) => {
    const made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    return made;
  };
  const buffers = { positions: buffer(positions), colours: buffer(colours), route: buffer(route) };
  const at = Object.fromEntries(["place", "colour"].map((n) => [n, gl.getAttribLocation(program, n)]));
  const uniform = Object.fromEntries(["view", "size", "paint"].map((n) => [n, gl.getUniformLocation(program, n)]));

  // Everything is in whole numbers of the data: step metres each.
  const median = (axis) => {
    const some = [];
    for (let k = axis; k < positions.length && some.length < 5000; k += 3) some.push(positions[k]);
    return some.sort((a, b) => a - b)[some.length >> 1] || 0;
  };
  const reach = () => {
    const far = [];
    for (let k = 0; k < positions.length && far.length < 5000; k += 3)
      far.push(Math.hypot(positions[k] - look[0], positions[k + 1] - look[1]));
    return far.sort((a, b) => a - b)[Math.floor(far.length * 0.95)] || 1;
  };
  const look = [median(0), median(1), median(2)];
  const spread = Math.max(reach(), 1);
  let yaw = -0.6, pitch = 0.75, distance = 2.4 * spread, moving = 0, asked = false;

  const axes = () => {
    const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
    return { right: [cy, sy, 0], up: [-sy * sp, cy * sp, cp], back: [sy * cp, -cy * cp, sp] };
  };
  const matrix = () => {
    const { right, up, back } = axes();
    const eye = look.map((v, k) => v + distance * back[k]);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const f = 1 / Math.tan(0.4), aspect = canvas.width / canvas.height;
    const near = distance / 100, far = distance * 10 + 4 * spread;
    const c = (far + near) / (near - far), d = (2 * far * near) / (near - far);
    const m = [];
    for (let k = 0; k < 3; k++) m.push((f / aspect) * right[k], f * up[k], c * back[k], -back[k]);
    m.push((-f / aspect) * dot(right, eye), -f * dot(up, eye), -c * dot(back, eye) + d, dot(back, eye));
    return new Float32Array(m);
  };
  const draw = () => {
    asked = false;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight].map((n) => Math.round(n * devicePixelRatio));
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(uniform.view, false, matrix());
    // Fewer points while the view moves; any beginning of the list shows the whole.
    const count = moving ? Math.min(data.shown, 150000) : data.shown;
    gl.uniform1f(uniform.size, (2.2 * spread * canvas.height) / Math.sqrt(count));
    gl.uniform4f(uniform.paint, 0, 0, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.positions);
    gl.enableVertexAttribArray(at.place);
    gl.vertexAttribPointer(at.place, 3, gl.UNSIGNED_SHORT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers.colours);
    gl.enableVertexAttribArray(at.colour);
    gl.vertexAttribPointer(at.colour, 3, gl.UNSIGNED_BYTE, true, 0, 0);
    gl.drawArrays(gl.POINTS, 0, count);
    if (route.length >= 6) {
      gl.uniform4f(uniform.paint, 1, 0.45, 0.1, 1);
      gl.disableVertexAttribArray(at.colour);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers.route);
      gl.vertexAttribPointer(at.place, 3, gl.UNSIGNED_SHORT, false, 0, 0);
      gl.drawArrays(gl.LINE_STRIP, 0, route.length / 3);
    }
  };
  const redraw = () => {
    if (!asked) requestAnimationFrame(draw);
    asked = true;
  };
  const settle = () => {
    clearTimeout(moving);
    moving = setTimeout(() => { moving = 0; redraw(); }, 200);
    redraw();
  };
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("pointerdown", (e) => canvas.setPointerCapture(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    if (!e.buttons) return;
    if (e.shiftKey || e.buttons === 2) {
      const { right, up } = axes();
      const metres = (0.85 * distance) / canvas.clientHeight;
      for (let k = 0; k < 3; k++) look[k] += metres * (e.movementY * up[k] - e.movementX * right[k]);
    } else {
      yaw -= e.movementX / 200;
      pitch = Math.min(1.55, Math.max(-0.2, pitch + e.movementY / 200));
    }
    settle();
  });
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    distance = Math.min(20 * spread, Math.max(spread / 100, distance * Math.exp(e.deltaY / 800)));
    settle();
  }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (!turn) return;
    e.preventDefault();
    yaw += turn[0];
    pitch = Math.min(1.55, Math.max(-0.2, pitch + turn[1]));
    settle();
  });
  addEventListener("resize", redraw);
  redraw();
})();
