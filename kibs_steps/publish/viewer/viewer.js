// The city of one HTML file: triangles, colours by what one asks for, and what is known of what one clicks on.
// Map frame throughout: x east, y north, z up, metres from `data.origin`.
"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const TYPES = { f4: Float32Array, i4: Int32Array, u4: Uint32Array, u2: Uint16Array, u1: Uint8Array };
const HEIGHTS = ["#34265e", "#365c8d", "#277f8e", "#2ea67f", "#84cc5e", "#f0e55c"];
const KINDS = [["roof", "#b05442"], ["wall", "#e5dece"], ["ground", "#8c8a82"]];
const WALL = [0.9, 0.87, 0.81];
const STATUS = ["#2ea67f", "#f0b43c", "#e8752c", "#c23b4b", "#8a5a9e", "#365c8d", "#7a8086", "#26292e", "#5bb8d0", "#d08fb0", "#b9b4a8"];
const LODS = { "1.3": "#f0b43c", "1.2": "#e8752c", 0: "#c23b4b" };

async function unpacked(packed) {
  const bytes = Uint8Array.from(atob(packed.gzip), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new TYPES[packed.type](await new Response(stream).arrayBuffer());
}

function rgb(text) {
  return [1, 3, 5].map((i) => parseInt(text.slice(i, i + 2), 16) / 255);
}

function ramp(share) {
  const place = Math.min(Math.max(share, 0), 1) * (HEIGHTS.length - 1);
  const k = Math.min(Math.floor(place), HEIGHTS.length - 2);
  const [a, b] = [rgb(HEIGHTS[k]), rgb(HEIGHTS[k + 1])];
  return a.map((v, i) => v + (b[i] - v) * (place - k));
}

function hsv(hue, strength, light) {
  const f = (n) => {
    const k = (n + hue / 60) % 6;
    return light * (1 - strength * Math.max(0, Math.min(k, 4 - k, 1)));
  };
  return [f(5), f(3), f(1)];
}

(async () => {
  const [positions, ofTriangle, kind, slope, azimuth, status, section, ofSurface, terrain] = await Promise.all(
    ["positions", "surface", "kind", "slope", "azimuth", "status", "section", "building", "terrain"].map((name) => unpacked(data.arrays[name])));
  const buildings = data.buildings;
  const highest = data.highest;

  // Colours by mode: what a surface looks like, and the key that explains it.
  const MODES = {
    "height above ground": {
      of: (s) => (kind[s] === 0 ? ramp(buildings.height[ofSurface[s]] / highest) : WALL),
      key: () => HEIGHTS.map((c, i) => [c, `${+((i / (HEIGHTS.length - 1)) * highest).toFixed(1)} m`]),
    },
    "slope and direction": {
      of: (s) => (kind[s] === 0 ? (azimuth[s] === 65535 ? [0.94, 0.94, 0.94] : hsv(azimuth[s], Math.min(0.15 + slope[s] * 0.018, 0.75), 0.94)) : WALL),
      key: () => [["N", 0], ["E", 90], ["S", 180], ["W", 270]].map(([n, a]) => [`rgb(${hsv(a, 0.7, 0.94).map((v) => Math.round(v * 255))})`, `faces ${n}; paler is flatter`]),
    },
    "status of roof sections": {
      of: (s) => (kind[s] === 0 ? rgb(STATUS[status[s] % STATUS.length]) : WALL),
      key: () => data.statuses.map((name, i) => [STATUS[i % STATUS.length], name]),
    },
    "level of detail": {
      of: (s) => (kind[s] === 0 ? rgb(LODS[buildings.lod[ofSurface[s]]] || "#2ea67f") : WALL),
      key: () => [["#2ea67f", "full roof"], [LODS["1.3"], "1.3: flat sections"], [LODS["1.2"], "1.2: one block"]],
    },
    "kind of surface": { of: (s) => rgb(KINDS[kind[s]][1]), key: () => KINDS.map(([name, c]) => [c, name]) },
  };

  const renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  renderer.outputColorSpace = THREE.SRGBColorSpace;
  renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
  document.body.prepend(renderer.domElement);
  const scene = new THREE.Scene();
  scene.background = new THREE.Color("#dfe6ec");
  const camera = new THREE.PerspectiveCamera(40, 1, 1, 1e5);
  camera.up.set(0, 0, 1);
  scene.add(new THREE.HemisphereLight(0xffffff, 0xa09888, 1.9));
  const sun = new THREE.DirectionalLight(0xfff4e0, 1.7);
  sun.position.set(-0.5, -0.6, 0.9);
  scene.add(sun);

  const points = new Float32Array(positions.length);
  for (let i = 0; i < points.length; i++) points[i] = positions[i] / 100;
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
  geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(points.length), 3));
  geometry.computeVertexNormals();
  const city = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ vertexColors: true, side: THREE.DoubleSide }));
  scene.add(city);

  const { cols, rows } = data.terrain;
  const ground = new THREE.BufferGeometry();
  const [uv, faces] = [[], []];
  for (let r = 0; r < rows; r++) {
    for (let c = 0; c < cols; c++) {
      uv.push(c / (cols - 1), 1 - r / (rows - 1));
      if (r && c) {
        const k = r * cols + c;
        faces.push(k - cols - 1, k - 1, k, k - cols - 1, k, k - cols);
      }
    }
  }
  ground.setAttribute("position", new THREE.BufferAttribute(terrain, 3));
  ground.setAttribute("uv", new THREE.BufferAttribute(new Float32Array(uv), 2));
  ground.setIndex(faces);
  ground.computeVertexNormals();
  const plain = new THREE.MeshLambertMaterial({ color: "#cfcdc2", side: THREE.DoubleSide });
  const land = new THREE.Mesh(ground, plain);
  land.position.z = -0.15; // below the buildings' own ground
  scene.add(land);

  const outline = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ color: "#ff2bd6" }));
  scene.add(outline);

  const controls = new THREE.MapControls(camera, renderer.domElement);
  controls.maxPolarAngle = 1.55;
  geometry.computeBoundingSphere();
  const corners = [0, terrain.length - 3].map((i) => new THREE.Vector3(...terrain.subarray(i, i + 3)));
  const size = Math.hypot(corners[0].x - corners[1].x, corners[0].y - corners[1].y);
  const middle = corners[0].lerp(corners[1], 0.5).setZ(terrain[3 * (Math.floor(rows / 2) * cols + Math.floor(cols / 2)) + 2]);
  controls.target.copy(middle);
  camera.position.set(middle.x - 0.15 * size, middle.y - 0.62 * size, middle.z + 0.5 * size);
  camera.near = size / 2000;
  camera.far = size * 20;

  const draw = () => renderer.render(scene, camera);
  const fit = () => {
    renderer.setSize(window.innerWidth, window.innerHeight);
    camera.aspect = window.innerWidth / window.innerHeight;
    camera.updateProjectionMatrix();
    controls.update();
    draw();
  };
  controls.addEventListener("change", draw);
  window.addEventListener("resize", fit);

  const paint = (name) => {
    const colours = geometry.attributes.color.array;
    const mode = MODES[name];
    const known = new Map();
    for (let t = 0; t < ofTriangle.length; t++) {
      const s = ofTriangle[t];
      if (!known.has(s)) known.set(s, mode.of(s).map((v) => Math.pow(v, 2.2)));
      for (let k = 0; k < 3; k++) colours.set(known.get(s), 9 * t + 3 * k);
    }
    geometry.attributes.color.needsUpdate = true;
    const key = document.getElementById("key");
    key.replaceChildren(...mode.key().map(([colour, text]) => {
      const line = document.createElement("div");
      const patch = document.createElement("span");
      patch.style.background = colour;
      line.append(patch, text);
      return line;
    }));
    draw();
  };

  const table = (values) => {
    const body = document.createElement("table");
    for (const [name, value] of Object.entries(values)) {
      if (value === null || value === undefined || value === "") continue;
      const row = body.insertRow();
      row.insertCell().textContent = name;
      row.insertCell().textContent = value;
    }
    return body;
  };
  const heading = (text) => Object.assign(document.createElement("h2"), { textContent: text });
  const show = (triangle) => {
    const facts = document.getElementById("facts");
    facts.hidden = triangle === null;
    if (triangle === null) {
      outline.geometry = new THREE.BufferGeometry();
      return draw();
    }
    const s = ofTriangle[triangle];
    const b = ofSurface[s];
    const values = Object.fromEntries(Object.entries(buildings).map(([name, column]) => [name, column[b]]));
    facts.replaceChildren(heading("building"), table(values), heading(KINDS[kind[s]][0]));
    if (kind[s] === 0) {
      const turned = azimuth[s] === 65535 ? null : azimuth[s] + "°";
      facts.append(table({ section_id: section[s] || null, status: section[s] ? data.statuses[status[s]] : null, slope: slope[s].toFixed(1) + "°", azimuth: turned }));
    }
    const lines = [];
    for (let t = 0; t < ofTriangle.length; t++) {
      if (ofSurface[ofTriangle[t]] !== b) continue;
      for (let k = 0; k < 3; k++) lines.push(...points.subarray(9 * t + 3 * k, 9 * t + 3 * k + 3), ...points.subarray(9 * t + 3 * ((k + 1) % 3), 9 * t + 3 * ((k + 1) % 3) + 3));
    }
    outline.geometry = new THREE.BufferGeometry();
    outline.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(lines), 3));
    draw();
  };
  const ray = new THREE.Raycaster();
  let pressed = null;
  renderer.domElement.addEventListener("pointerdown", (e) => { pressed = [e.clientX, e.clientY]; });
  renderer.domElement.addEventListener("pointerup", (e) => {
    if (!pressed || Math.hypot(e.clientX - pressed[0], e.clientY - pressed[1]) > 4) return;
    const place = new THREE.Vector2((e.clientX / window.innerWidth) * 2 - 1, 1 - (e.clientY / window.innerHeight) * 2);
    ray.setFromCamera(place, camera);
    const [hit] = ray.intersectObject(city);
    show(hit ? hit.faceIndex : null);
  });

  document.getElementById("title").textContent = data.title;
  document.getElementById("note").textContent = data.note;
  const choice = document.getElementById("mode");
  choice.append(...Object.keys(MODES).map((name) => new Option(name)));
  choice.addEventListener("change", () => paint(choice.value));
  // `viewer.html#mode=2&pick=17` opens with a mode and a building chosen: for links, and for tests.
  const asked = new URLSearchParams(location.hash.slice(1));
  choice.selectedIndex = Math.min(Number(asked.get("mode")) || 0, choice.options.length - 1);
  paint(choice.value);
  fit();
  if (asked.has("pick")) {
    const b = buildings.building_id.indexOf(Number(asked.get("pick")));
    const t = ofTriangle.findIndex((s) => ofSurface[s] === b && kind[s] === 0);
    show(t < 0 ? null : t);
  }
  const texture = await new Promise((done, failed) => {
    const picture = new Image();
    picture.onload = () => done(picture);
    picture.onerror = failed;
    picture.src = data.image;
  });
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [texture.width, texture.height];
  canvas.getContext("2d").drawImage(texture, 0, 0);
  const map = new THREE.CanvasTexture(canvas);
  map.colorSpace = THREE.SRGBColorSpace;
  const photographed = new THREE.MeshBasicMaterial({ map, side: THREE.DoubleSide });
  const box = document.getElementById("image");
  const dress = () => { land.material = box.checked ? photographed : plain; draw(); };
  box.addEventListener("change", dress);
  dress();
  document.body.dataset.ready = "yes";
})().catch((error) => { document.getElementById("note").textContent = `This browser cannot show the city: ${error}`; });
