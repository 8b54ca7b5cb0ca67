// The page that `gvtools export --format html` writes. `library` is library.min.js.
// A view is {position, turn, lens}: where the camera is, its axes (right, up, back) as a
// quaternion, and [width, fx, fy, cx, cy] of a picture, in shares of its height. The picture is
// seen whole, as large as the window allows. Position and turn are in the scene's frame.
"use strict";

const find = (name) => document.getElementById(name);
const scene = JSON.parse(find("scene").textContent), stage = find("stage");
const { Quaternion, Vector3 } = library, RIGHT = new Vector3(1, 0, 0);
// Seconds of a flight to a camera; radians of a turn by a pixel; typical depths walked in a second.
const FLIGHT = 0.8, TURN = 0.004, SPEED = 0.7;
const SOURCES = ["observed", "generated"];
// The axis that a key moves along, and which way.
const MOVES = { KeyW: [2, -1], KeyS: [2, 1], KeyA: [0, -1], KeyD: [0, 1], KeyQ: [1, -1],
  KeyE: [1, 1], ArrowUp: [2, -1], ArrowDown: [2, 1], ArrowLeft: [0, -1], ArrowRight: [0, 1] };
// Where a Gaussian ends, as the run draws it: at this alpha, so many standard deviations out.
const LEAST = 1 / 255, REACH = Math.sqrt(2 * Math.log(255));

const view = { position: new Vector3(), turn: new Quaternion(), lens: [1, 1, 1, 0.5, 0.5] };
const shown = { round: scene.rounds.at(-1), observed: true, generated: true };
const groups = [], keys = new Set();
let renderer, spark, target, quad, world, camera, controls, flight, saving, written, last;
let walking = false, dirty = true, elsewhere = true, size = [0, 0];

function fail(textContent) {
  Object.assign(find("problem"), { textContent, hidden: false });
  document.body.dataset.state = "failed";
}

async function unpack(element) {
  const text = element.textContent;
  element.remove();
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint32Array(await new Response(stream).arrayBuffer());
}

// Arrays of four words a Gaussian, one after the other, see pack_gaussians in page.py.
function splatsOf(words, count) {
  const { maxSplats } = library.utils.getTextureSize(count);
  const [first, second, sh1, sh2, sh3a, sh3b] = Array.from(
    { length: words.length / (4 * count) }, (_, number) => {
      const padded = new Uint32Array(4 * maxSplats);
      padded.set(words.subarray(4 * count * number, 4 * count * (number + 1)));
      return padded;
    });
  return new library.ExtSplats(
    { extArrays: [first, second], numSplats: count, extra: { sh1, sh2, sh3a, sh3b } });
}

// What the run multiplies red, green and blue by: as the photographs near the view are exposed.
function expose() {
  if (!scene.exposures) return;
  const ahead = new Vector3(0, 0, -1).applyQuaternion(view.turn);
  const { shift, turn, count, of } = scene.exposures;
  const near = of.map(({ position, forward, log }) => ({ log, apart: ahead.angleTo(
    new Vector3(...forward)) / turn + view.position.distanceTo(new Vector3(...position)) / shift,
  })).sort((a, b) => a.apart - b.apart).slice(0, count);
  const weights = near.map(({ apart }) => Math.exp(near[0].apart - apart));
  const sum = (of) => weights.reduce((total, weight, i) => total + weight * of(near[i]), 0);
  const gain = [0, 1, 2].map((i) => Math.exp(sum(({ log }) => log[i]) / sum(() => 1)));
  for (const { mesh, fitted } of groups) if (fitted) mesh.recolor.fromArray(gain);
}

// As the run's own splatter does: the linearisation is taken at most 0.15 of the picture beside it,
// no Gaussian stops more than 0.99 of the light, and below 2 / 255 alpha falls twice as fast.
function drawAsTheRun(material) {
  for (const [shader, from, to] of [
    ["vertexShader", "vec2 J2 = -(J1 * viewCenter.xy) * invZ;", `
      vec2 held = clamp(clipCenter.xy / clipCenter.w, -1.3, 1.3) + projectionMatrix[2].xy;
      vec2 J2 = J1 * held / vec2(projectionMatrix[0][0], projectionMatrix[1][1]);`],
    ["fragmentShader", "if (rgba.a < minAlpha) {",
      "rgba.a = min(rgba.a, 0.99);\nrgba.a = min(rgba.a, 2.0 * rgba.a - 2.0 * minAlpha);\n" +
      "if (rgba.a <= 0.0) {"],
    ["fragmentShader", "if (encodeLinear) {", "if (false) {"],
  ]) {
    if (!material[shader].includes(from)) throw new Error(`another ${shader} than expected`);
    material[shader] = material[shader].replace(from, to);
  }
}

async function start() {
  const canvas = document.createElement("canvas"), plain = { antialias: false, alpha: false };
  const context = canvas.getContext("webgl2", plain);
  if (!context) {
    return fail("This browser has no WebGL 2, which draws the scene; expected one that has it, " +
      "with hardware acceleration switched on.");
  }
  stage.append(canvas);
  canvas.addEventListener("webglcontextlost", () => fail("The graphics card gave up; load again."));
  renderer = new library.WebGLRenderer({ canvas, context, ...plain });
  const soft = { [scene.mip ? "blurAmount" : "preBlurAmount"]: 0.3 };
  spark = new library.SparkRenderer({
    renderer, onDirty: () => { dirty = true; }, accumExtSplats: true, enableLod: false, clipXY: 8,
    sortRadial: false, minAlpha: LEAST, maxStdDev: REACH, maxPixelRadius: 8192, blurAmount: 0, ...soft });
  drawAsTheRun(spark.material);
  // Sums of many faint colours need more than the 8 bits of a window.
  const deep = renderer.extensions.has("EXT_color_buffer_float") ||
    renderer.extensions.has("EXT_color_buffer_half_float");
  target = new library.WebGLRenderTarget(
    1, 1, { depthBuffer: false, ...deep && { type: library.HalfFloatType } });
  const vertexShader = "void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }";
  renderer.setClearColor(0, 0);
  const light = scene.backdrop ? "max(lit.a, 0.5)" : "1.0";
  const fragmentShader = `uniform sampler2D picture;
    void main() {
      vec4 lit = texelFetch(picture, ivec2(gl_FragCoord), 0);
      gl_FragColor = vec4(lit.rgb / ${light}, 1.0);
    }`;
  quad = new library.FullScreenQuad(new library.ShaderMaterial(
    { vertexShader, fragmentShader, uniforms: { picture: { value: target.texture } } }));
  world = new library.Scene();
  world.add(spark);
  camera = new library.PerspectiveCamera(50, 1, scene.near, scene.far);
  camera.up.set(...scene.up);
  controls = new library.OrbitControls(camera, canvas);
  controls.addEventListener("start", () => { flight = undefined; });
  controls.addEventListener("change", () => {
    if (walking || flight) return;
    view.position.copy(camera.position);
    view.turn.copy(camera.quaternion);
    moved();
  });
  walk(canvas);
  if (!readAddress()) show(scene.start);
  requestAnimationFrame(frame);
  for (const element of [...document.querySelectorAll("script.splats")]) {
    const [round, generated, fitted, count] = element.dataset.group.split(" ").map(Number);
    const mesh = new library.SplatMesh({ extSplats: splatsOf(await unpack(element), count) });
    await mesh.initialized;
    world.add(mesh);
    groups.push({ mesh, round, generated, fitted });
    choose();
  }
  document.body.dataset.state = "loaded";
  dirty = true;
}

function frame(time) {
  requestAnimationFrame(frame);
  fly(time);
  step(time);
  const { clientWidth: width, clientHeight: height } = stage;
  if (width !== size[0] || height !== size[1]) {
    size = [width, height];
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    renderer.setSize(width, height);
    target.setSize(renderer.domElement.width, renderer.domElement.height);
    dirty = true;
  }
  if (!dirty || !width || !height) return;
  dirty = false;
  place();
  expose();
  // Spark by itself would sort anew after 2.6 degrees or 0.001 scene units alone.
  if (elsewhere) spark.sortedDir.setScalar(0);
  elsewhere = false;
  renderer.setRenderTarget(target);
  renderer.render(world, camera);
  renderer.setRenderTarget(null);
  quad.render(renderer);
  const { dataset } = document.body;
  if (dataset.state === "loaded" && spark.activeSplats && !spark.sorting) dataset.state = "shown";
}

// The camera's projection: that of the lens, with its picture in the middle of the window.
function place() {
  const [aspect, fx, fy, cx, cy] = view.lens, [width, height] = size, { near, far } = scene;
  const scale = Math.min(height, width / aspect);
  camera.fov = 360 / Math.PI * Math.atan(height / (2 * fy * scale));
  camera.projectionMatrix.set(
    2 * fx * scale / width, 0, -2 * (cx - aspect / 2) * scale / width, 0,
    0, 2 * fy * scale / height, 2 * (cy - 0.5) * scale / height, 0,
    0, 0, -(far + near) / (far - near), -2 * far * near / (far - near),
    0, 0, -1, 0,
  );
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}

function moved() {
  dirty = elsewhere = true;
  document.querySelector("#photographs [aria-current]")?.removeAttribute("aria-current");
  clearTimeout(saving);
  saving = setTimeout(writeAddress, 300);
}

function show({ position, turn, lens }) {
  view.position.set(...position);
  view.turn.set(...turn).normalize();
  view.lens = [...lens];
  camera.position.copy(view.position);
  camera.quaternion.copy(view.turn);
  // What the mouse turns the view around: its middle, at the depth that is usual in the scene.
  controls.target.set(0, 0, -scene.depth).applyQuaternion(view.turn).add(view.position);
  moved();
}

function flyTo(goal) {
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const from = { position: view.position.clone(), turn: view.turn.clone(), lens: view.lens };
  flight = { from, goal, end: still ? 0 : performance.now() + 1000 * FLIGHT };
}

function fly(time) {
  if (!flight) return;
  const { from, goal, end } = flight;
  const left = Math.min(1, Math.max(0, (end - time) / (1000 * FLIGHT)));
  const share = 1 - left * left * (3 - 2 * left);
  const turn = from.turn.clone().slerp(new Quaternion(...goal.turn), share);
  const lens = goal.lens.map((x, i) => from.lens[i] + share * (x - from.lens[i]));
  show({ position: from.position.clone().lerp(new Vector3(...goal.position), share), turn, lens });
  if (share < 1) return;
  flight = show(goal);
  find("photographs").children[scene.cameras.indexOf(goal)]?.setAttribute("aria-current", "true");
}

// Walking: the keys move, dragging turns the head.
function walk(canvas) {
  canvas.addEventListener("pointermove", (event) => {
    if (!walking || !event.buttons) return;
    flight = undefined;
    const aside = new Quaternion().setFromAxisAngle(camera.up, TURN * event.movementX);
    const upwards = new Quaternion().setFromAxisAngle(RIGHT, TURN * event.movementY);
    show({ ...view, turn: aside.multiply(view.turn).multiply(upwards) });
  });
  canvas.addEventListener("wheel", (event) => {
    if (walking) go(2, Math.sign(event.deltaY), 0.1);
  }, { passive: true });
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input")) return;
    if (event.code === "KeyH") document.body.classList.toggle("bare");
    if (event.code === "KeyH" || event.code in MOVES) moved();
    if (!(event.code in MOVES)) return;
    event.preventDefault();
    flight = setWalking(true);
    keys.add(event.code);
  });
  addEventListener("keyup", (event) => keys.delete(event.code));
  addEventListener("blur", () => keys.clear());
}

function step(time) {
  const seconds = Math.min(0.1, (time - (last ?? time)) / 1000);
  last = time;
  for (const key of keys) go(...MOVES[key], seconds);
}

function go(axis, sign, seconds) {
  const way = new Vector3().setComponent(axis, sign * SPEED * scene.depth * seconds);
  show({ ...view, position: way.applyQuaternion(view.turn).add(view.position) });
}

function setWalking(on) {
  walking = on;
  if (controls) controls.enabled = !on;
  for (const name of ["orbit", "walk"]) find(name).ariaPressed = String(on === (name === "walk"));
}

// What is drawn: groups of Gaussians by round and source.
function choose() {
  for (const { mesh, round, generated } of groups) {
    mesh.visible = round <= shown.round && (generated ? shown.generated : shown.observed);
  }
  find("after").textContent = shown.round === 0 ? "the context" : `round ${shown.round}`;
  find("round").value = String(scene.rounds.indexOf(shown.round));
  for (const source of SOURCES) find(source).checked = shown[source];
  dirty = true;
}

// The address keeps the view, so that it can be shared: #v=position,turn,lens&round=2&observed=0
function writeAddress() {
  const numbers = [...view.position.toArray(), ...view.turn.toArray(), ...view.lens];
  const parts = [`v=${numbers.map((x) => Number(x.toPrecision(7))).join(",")}`];
  if (shown.round !== scene.rounds.at(-1)) parts.push(`round=${shown.round}`);
  for (const source of SOURCES) if (!shown[source]) parts.push(`${source}=0`);
  if (document.body.classList.contains("bare")) parts.push("bare=1");
  written = `#${parts.join("&")}`;
  // Where a page may not change its address, as in some frames, it goes without.
  try { location.replace(written); } catch { written = location.hash; }
}

function readAddress() {
  const words = new URLSearchParams(location.hash.slice(1));
  const numbers = (words.get("v") ?? "").split(",").map(Number);
  const round = Number(words.get("round") ?? Infinity);
  if (round >= 0) shown.round = Math.min(Math.floor(round), scene.rounds.at(-1));
  for (const source of SOURCES) shown[source] = words.get(source) !== "0";
  document.body.classList.toggle("bare", words.get("bare") === "1");
  choose();
  const [position, turn, lens] = [[0, 3], [3, 7], [7]].map((ends) => numbers.slice(...ends));
  const sound = numbers.length === 12 && numbers.every(Number.isFinite) && turn.some(Boolean) &&
    lens.slice(0, 3).every((x) => x > 0);
  if (sound) flight = show({ position, turn, lens });
  return sound;
}

addEventListener("hashchange", () => { if (location.hash !== written) readAddress(); });
find("orbit").addEventListener("click", () => setWalking(false));
find("walk").addEventListener("click", () => setWalking(true));
find("choices").addEventListener("input", () => {
  shown.round = scene.rounds[find("round").valueAsNumber];
  for (const source of SOURCES) shown[source] = find(source).checked;
  choose();
  moved();
});
[...find("photographs").children].forEach((button, number) =>
  button.addEventListener("click", () => renderer && flyTo(scene.cameras[number])));
start().catch((error) => fail(`The scene cannot be drawn: ${error.message}`));
