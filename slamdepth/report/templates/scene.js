// SPDX-License-Identifier: Apache-2.0
// The 3D view of a page: mesh, path, keyframes and loops of a run, and a slider over its keyframes.
"use strict";
(() => {
  const root = document.getElementById("scene");
  const find = (name) => root.querySelector("." + name);
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const frames = data.frames;

  // ---------- numbers ----------
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  const floats = (text) => new Float32Array(bytes(text));
  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

  // ---------- the slider: works without WebGL, too ----------
  const slider = find("slider");
  const listeners = [];
  let current = 0;

  function show(n) {
    current = Math.max(0, Math.min(frames.length - 1, n));
    const frame = frames[current];
    slider.value = current;
    find("image").src = frame.image;
    find("depth").src = frame.depth;
    const map = data.maps.length > 1 ? ` · map ${data.maps[frame.map].number}` : "";
    find("when").textContent = `${frame.t.toFixed(2)} s · keyframe ${frame.id}${map}`;
    listeners.forEach((listener) => listener(frame));
  }

  let playing = 0;
  function play(on) {
    clearInterval(playing);
    playing = on ? setInterval(() => show((current + 1) % frames.length), 160) : 0;
    find("play").textContent = on ? "Pause" : "Play";
    find("play").setAttribute("aria-pressed", String(on));
  }

  if (frames.length) {
    slider.max = frames.length - 1;
    slider.addEventListener("input", () => { play(false); show(Number(slider.value)); });
    find("play").addEventListener("click", () => play(!playing));
    find("time").hidden = false;
    find("images").hidden = false;
  } else {
    root.classList.add("alone");
  }

  // ---------- WebGL ----------
  let renderer;
  try {
    const log = console.error;
    console.error = () => {};  // three.js also prints what it throws
    try {
      renderer = new THREE.WebGLRenderer({ canvas: find("canvas"), antialias: true, alpha: true });
    } finally {
      console.error = log;
    }
  } catch (error) {
    find("missing").hidden = false;
    find("stage").hidden = true;
    find("tools").hidden = true;
    if (frames.length) show(0);
    root.dataset.state = "no-webgl";
    return;
  }
  renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
  renderer.setClearColor(0, 0);
  const canvas = renderer.domElement;
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(50, 1.5, 0.01, 100);
  const lamp = new THREE.DirectionalLight(0xffffff, 0.3);
  camera.add(lamp, lamp.target);
  lamp.position.set(0, 0, 0);
  lamp.target.position.set(0, 0, -1);
  scene.add(new THREE.AmbientLight(0xffffff, 0.72), camera);

  let wanted = false;
  function draw() {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(() => {
      wanted = false;
      renderer.render(scene, camera);
      root.dataset.drawn = String(Number(root.dataset.drawn || 0) + 1);
    });
  }

  // ---------- lines of a width in pixels ----------
  const resolution = { value: new THREE.Vector2(1, 1) };
  const lines = [];  // materials with the names of their colours

  function fatLines(ends, width, colour, options = {}) {
    const geometry = new THREE.InstancedBufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute([0, -1, 0, 0, 1, 0, 1, -1, 0, 1, 1, 0], 3));
    geometry.setIndex([0, 2, 1, 1, 2, 3]);
    const buffer = new THREE.InstancedInterleavedBuffer(ends, 6, 1);
    geometry.setAttribute("a", new THREE.InterleavedBufferAttribute(buffer, 3, 0));
    geometry.setAttribute("b", new THREE.InterleavedBufferAttribute(buffer, 3, 3));
    geometry.instanceCount = ends.length / 6;
    const material = new THREE.ShaderMaterial({
      uniforms: {
        colour: { value: new THREE.Color() }, opacity: { value: options.opacity ?? 1 },
        width: { value: width * renderer.getPixelRatio() }, resolution,
      },
      vertexShader: `
        attribute vec3 a, b;
        uniform float width;
        uniform vec2 resolution;
        void main() {
          vec4 p = modelViewMatrix * vec4(a, 1.0), q = modelViewMatrix * vec4(b, 1.0);
          float near = -1.0001 * projectionMatrix[3][2] / (projectionMatrix[2][2] - 1.0);
          if (p.z > near && q.z < near) p = mix(p, q, (near - p.z) / (q.z - p.z));
          if (q.z > near && p.z < near) q = mix(q, p, (near - q.z) / (p.z - q.z));
          vec4 u = projectionMatrix * p, v = projectionMatrix * q;
          vec2 along = (v.xy / v.w - u.xy / u.w) * resolution;
          along = length(along) > 1e-6 ? normalize(along) : vec2(1.0, 0.0);
          vec2 side = vec2(-along.y, along.x) * position.y + along * (position.x * 2.0 - 1.0) * 0.5;
          gl_Position = position.x < 0.5 ? u : v;
          gl_Position.xy += side * width / resolution * gl_Position.w;
          if (p.z > near && q.z > near) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
        }`,
      fragmentShader: `
        uniform vec3 colour;
        uniform float opacity;
        void main() { gl_FragColor = vec4(colour, opacity); }`,
      side: THREE.DoubleSide,
      transparent: true,
      depthTest: !options.through,
      depthWrite: !options.through && (options.opacity ?? 1) === 1,
    });
    lines.push([material, colour]);
    const mesh = new THREE.Mesh(geometry, material);
    mesh.frustumCulled = false;
    mesh.renderOrder = options.through ? 3 : 2;
    return mesh;
  }

  function paint() {
    for (const [material, name] of lines) material.uniforms.colour.value.set(css(name));
    for (const part of parts) if (part.points) part.points.children.forEach((p) => p.material.color.set(css("muted")));
    draw();
  }

  // ---------- the maps ----------
  const [halfWidth, halfHeight] = data.aspect;

  function frustum(pose, depth) {  // pose: 3 x 4, row by row, camera to world
    const at = (x, y, z) => [0, 4, 8].map((r) => pose[r] * x + pose[r + 1] * y + pose[r + 2] * z + pose[r + 3]);
    const c = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) =>
      at(x * halfWidth * depth, y * halfHeight * depth, depth));
    const eye = at(0, 0, 0);
    return { eye, c, ends: c.flatMap((p, n) => [...eye, ...p, ...p, ...c[(n + 1) % 4]]) };
  }

  function meshOf(packed) {
    const steps = new Uint16Array(bytes(packed.vertices));
    const positions = new Float32Array(steps.length);
    for (let i = 0; i < steps.length; i++) positions[i] = packed.low[i % 3] + packed.step[i % 3] * steps[i];
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(bytes(packed.colours)), 3, true));
    geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(bytes(packed.triangles)), 1));
    // walls and ceilings are left out where they are seen from behind
    return new THREE.Mesh(geometry, new THREE.MeshPhongMaterial({
      vertexColors: true, flatShading: true, shininess: 0, specular: 0, side: THREE.FrontSide,
    }));
  }

  function partsOf(map) {
    const made = {};
    const group = (name, ...children) => {
      made[name] = new THREE.Group();
      made[name].add(...children);
    };
    const poses = floats(map.keyframes);
    const pose = (row) => poses.subarray(12 * row, 12 * row + 12);
    const place = (row) => [3, 7, 11].map((i) => poses[12 * row + i]);
    if (map.mesh) group("mesh", meshOf(map.mesh));
    const points = floats(map.points);
    if (points.length) {
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
      const material = new THREE.PointsMaterial({ size: 2, sizeAttenuation: false });
      group("points", new THREE.Points(geometry, material));
      made.points.visible = !map.mesh;
    }
    const path = floats(map.path);
    if (path.length) {
      group("path", fatLines(path, 3.2, "estimate"), fatLines(path, 2, "estimate", { through: true, opacity: 0.22 }));
    }
    if (map.truth) group("truth", fatLines(floats(map.truth), 2, "truth"));
    if (poses.length) {
      const ends = [];
      for (let row = 0; row < poses.length / 12; row++) ends.push(...frustum(pose(row), 0.022 * map.size).ends);
      group("keyframes", fatLines(new Float32Array(ends), 1.2, "estimate", { opacity: 0.75 }));
    }
    if (map.loops.length) {
      const ends = new Float32Array(map.loops.flatMap(([i, j]) => [...place(i), ...place(j)]));
      group("loops", fatLines(ends, 2.2, "good"), fatLines(ends, 1.6, "good", { through: true, opacity: 0.3 }));
    }
    made.all = new THREE.Group();
    made.all.add(...Object.values(made).filter((one) => one !== made.all));
    made.pose = pose;
    return made;
  }

  const parts = data.maps.map(partsOf);
  let shown = 0;

  function showMap(n) {
    setFollowing(false);
    parts.forEach((part) => scene.remove(part.all));
    shown = n;
    scene.add(parts[n].all);
    root.querySelectorAll(".part").forEach((box) => {
      const part = parts[n][box.value];
      box.parentElement.hidden = !part;
      if (part) box.checked = part.visible;
    });
    const chooser = find("map");
    if (chooser) chooser.value = n;
    look(data.maps[n].eye, data.maps[n].target, data.maps[n].up);
  }

  function clear() {  // frustums are in the way of a camera that is among them
    const box = root.querySelector(".part[value=keyframes]");
    if (parts[shown].keyframes) parts[shown].keyframes.visible = box.checked && !following;
  }

  root.querySelectorAll(".part").forEach((box) => box.addEventListener("change", () => {
    const part = parts[shown][box.value];
    if (part) part.visible = box.checked;
    clear();
    draw();
  }));
  if (find("map")) {
    find("map").addEventListener("change", () => {
      const n = Number(find("map").value), first = frames.findIndex((frame) => frame.map === n);
      play(false);
      if (first < 0) showMap(n); else show(first);
    });
  }

  // ---------- the camera: a turntable about a target ----------
  const up = new THREE.Vector3(0, -1, 0), target = new THREE.Vector3(), offset = new THREE.Vector3();
  let following = false;

  function look(eye, at, upwards) {
    setFollowing(false);
    up.fromArray(upwards).normalize();
    target.fromArray(at);
    offset.fromArray(eye).sub(target);
    place();
  }

  function place() {
    camera.up.copy(up);
    camera.position.copy(target).add(offset);
    camera.lookAt(target);
    clip(offset.length());
  }

  function clip(distance) {
    const size = data.maps[shown].size;
    camera.near = Math.max(1e-3 * size, 0.002 * distance);
    camera.far = 4 * size + 3 * distance;
    camera.updateProjectionMatrix();
    draw();
  }

  function turn(dx, dy) {
    setFollowing(false);
    const right = new THREE.Vector3().crossVectors(offset, up).normalize();
    const angle = offset.angleTo(up);
    const tilt = Math.max(0.03, Math.min(Math.PI - 0.03, angle - dy)) - angle;
    if (right.lengthSq() > 0) offset.applyAxisAngle(right, -tilt);
    offset.applyAxisAngle(up, -dx);
    place();
  }

  function zoom(factor) {
    setFollowing(false);
    const size = data.maps[shown].size;
    offset.multiplyScalar(Math.max(0.01 * size, Math.min(6 * size, offset.length() * factor)) / offset.length());
    place();
  }

  function pan(dx, dy) {  // pixels
    setFollowing(false);
    const metres = 2 * offset.length() * Math.tan(camera.fov * Math.PI / 360) / canvas.clientHeight;
    const right = new THREE.Vector3().setFromMatrixColumn(camera.matrixWorld, 0);
    const above = new THREE.Vector3().setFromMatrixColumn(camera.matrixWorld, 1);
    target.addScaledVector(right, -dx * metres).addScaledVector(above, dy * metres);
    place();
  }

  function setFollowing(on) {
    if (on === following) return;
    following = on;
    mark.visible = !on;
    clear();
    find("follow").setAttribute("aria-pressed", String(on));
    if (!on) {  // turn about what the camera looks at
      const ahead = camera.getWorldDirection(new THREE.Vector3());
      const distance = Math.max(0.2 * data.maps[shown].size, 1e-3);
      target.copy(camera.position).addScaledVector(ahead, distance);
      offset.copy(camera.position).sub(target);
    }
  }

  function follow(frame) {  // a step behind the camera
    const m = parts[frame.map].pose(frame.row);
    const back = 0.07 * data.maps[frame.map].size;
    const column = (i) => new THREE.Vector3(m[i], m[4 + i], m[8 + i]);
    camera.position.copy(column(3)).addScaledVector(column(2), -back).addScaledVector(column(1), -0.25 * back);
    camera.up.copy(column(1)).negate();
    camera.lookAt(column(3).addScaledVector(column(2), back * 4));
    clip(back);
  }

  find("follow").addEventListener("click", () => {
    if (!frames.length) return;
    if (following) { const m = data.maps[shown]; look(m.eye, m.target, m.up); return; }
    setFollowing(true);
    show(current);
  });
  find("reset").addEventListener("click", () => showMap(shown));

  // ---------- mouse, fingers, keys ----------
  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY, event.button === 2 || event.shiftKey]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const [x, y, pans] = before;
    const dx = event.clientX - x, dy = event.clientY - y;
    if (fingers.size === 2) {
      const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, f]) => f);
      const apart = Math.hypot(x - other[0], y - other[1]);
      const now = Math.hypot(event.clientX - other[0], event.clientY - other[1]);
      pan(dx / 2, dy / 2);
      if (now > 5) zoom(apart / now);
    } else if (pans) {
      pan(dx, dy);
    } else {
      turn(dx * 0.006, dy * 0.006);
    }
    fingers.set(event.pointerId, [event.clientX, event.clientY, pans]);
  });
  for (const name of ["pointerup", "pointercancel", "lostpointercapture"]) {
    canvas.addEventListener(name, (event) => fingers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return;  // the page scrolls until the view is clicked
    event.preventDefault();
    zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.003));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const keys = {
      ArrowLeft: () => turn(0.08, 0), ArrowRight: () => turn(-0.08, 0),
      ArrowUp: () => turn(0, 0.08), ArrowDown: () => turn(0, -0.08),
      "+": () => zoom(0.9), "-": () => zoom(1.1),
    };
    if (!keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });

  // ---------- the keyframe of the slider, with its image ----------
  const mark = new THREE.Group();
  const texture = new THREE.Texture();
  const pane = new THREE.Mesh(new THREE.BufferGeometry(), new THREE.MeshBasicMaterial({
    map: texture, side: THREE.DoubleSide, transparent: true, opacity: 0.92,
  }));
  pane.renderOrder = 1;
  pane.geometry.setAttribute("uv", new THREE.Float32BufferAttribute([0, 1, 1, 1, 1, 0, 0, 0], 2));
  pane.geometry.setIndex([0, 2, 1, 0, 3, 2]);
  pane.frustumCulled = false;
  const ends = new Float32Array(8 * 6);
  const outline = fatLines(ends, 2.6, "scaled");
  mark.add(pane, outline);
  if (frames.length) scene.add(mark);
  const picture = new Image();
  picture.onload = () => { texture.image = picture; texture.needsUpdate = true; draw(); };

  listeners.push((frame) => {
    const goesOn = following;
    if (frame.map !== shown) { showMap(frame.map); setFollowing(goesOn); }
    const f = frustum(parts[frame.map].pose(frame.row), 0.06 * data.maps[frame.map].size);
    pane.geometry.setAttribute("position", new THREE.Float32BufferAttribute(f.c.flat(), 3));
    ends.set(f.ends);
    outline.geometry.attributes.a.data.needsUpdate = true;
    picture.src = frame.image;
    if (following) follow(frame);
    draw();
  });

  // ---------- size and colours ----------
  function resize() {
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;
    renderer.setSize(width, height, false);
    renderer.getDrawingBufferSize(resolution.value);
    camera.aspect = width / height;
    const across = Math.tan(27 * Math.PI / 180);  // a little more than the first view is made for, of 3:2
    camera.fov = 2 * Math.atan(Math.max(across / camera.aspect, across / 1.5)) * 180 / Math.PI;
    camera.updateProjectionMatrix();
    draw();
  }
  new ResizeObserver(resize).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", paint);
  canvas.addEventListener("webglcontextrestored", draw);

  showMap(frames.length ? frames[0].map : 0);
  resize();
  paint();
  if (frames.length) show(0);
  root.dataset.state = "drawn";
})();
