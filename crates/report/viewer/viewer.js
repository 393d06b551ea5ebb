// The interactive view of clouds and boxes in the report. It is bundled with three.js into assets/viewer.min.js; README.md says how.
import {
  BufferAttribute, BufferGeometry, Color, LineBasicMaterial, LineSegments, PerspectiveCamera, Points, PointsMaterial, Scene, Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

const bytes = (base64) => Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));

// Positions are whole centimetres, little-endian int16, x y z of each point (LiDAR frame).
const positions = (base64) => Float32Array.from(new Int16Array(bytes(base64).buffer), (v) => v / 100);

// The colour of each point is a byte: its number in the palette.
function colors(base64, palette) {
  const rgb = palette.map((css) => new Color(css)).map(({ r, g, b }) => [r, g, b]);
  return Float32Array.from(Array.from(bytes(base64), (number) => rgb[number]).flat());
}

// Edges of a box [x, y, z, dx, dy, dz, yaw], and a tick out of its front.
function edges([x, y, z, dx, dy, dz, yaw]) {
  const [s, c] = [Math.sin(yaw), Math.cos(yaw)];
  const at = (u, v, w) => [x + u * c - v * s, y + u * s + v * c, z + w];
  const corner = (i) => at(((i & 1) - 0.5) * dx, (((i >> 1) & 1) - 0.5) * dy, (((i >> 2) & 1) - 0.5) * dz);
  const out = [];
  for (let i = 0; i < 8; i++) for (const k of [1, 2, 4]) if (!(i & k)) out.push(...corner(i), ...corner(i | k));
  out.push(...at(0, 0, 0), ...at(dx / 2 + 0.8, 0, 0));
  return out;
}

function view(root, { blobs, scenes }) {
  const canvas = root.querySelector("canvas");
  let renderer;
  try {
    renderer = new WebGLRenderer({ canvas, antialias: true });
  } catch {
    root.classList.add("no-webgl");
    return;
  }
  const scene = new Scene();
  const camera = new PerspectiveCamera(55, 1, 0.1, 1000);
  camera.up.set(0, 0, 1);
  const controls = new OrbitControls(camera, canvas);
  controls.listenToKeyEvents(canvas);
  let shown = [];
  const hidden = new Set();
  let asked = false;
  const draw = () => {
    asked = false;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    const ratio = Math.min(window.devicePixelRatio, 2);
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(width, height, false);
      camera.aspect = width / Math.max(height, 1);
      camera.updateProjectionMatrix();
    }
    scene.background = new Color(getComputedStyle(root).getPropertyValue("--plot").trim() || "#ffffff");
    controls.update();
    renderer.render(scene, camera);
  };
  const ask = () => { if (!asked) { asked = true; requestAnimationFrame(draw); } };
  const layers = root.querySelector(".layers");
  const applied = root.querySelector(".switch input");
  const open = () => {
    const frame = scenes[select.value | 0];
    for (const { object } of shown) { scene.remove(object); object.geometry.dispose(); object.material.dispose(); }
    shown = ((applied?.checked && frame.on) || frame.layers).map((layer) => {
      const geometry = new BufferGeometry();
      const isCloud = layer.points !== undefined;
      const at = isCloud ? positions(blobs[layer.points]) : new Float32Array(layer.boxes.flatMap(edges));
      geometry.setAttribute("position", new BufferAttribute(at, 3));
      const vertexColors = layer.colors !== undefined;
      if (vertexColors) geometry.setAttribute("color", new BufferAttribute(colors(blobs[layer.colors], layer.palette), 3));
      const color = new Color(vertexColors ? "#ffffff" : layer.color);
      const object = isCloud
        ? new Points(geometry, new PointsMaterial({ color, vertexColors, size: 2, sizeAttenuation: false }))
        : new LineSegments(geometry, new LineBasicMaterial({ color }));
      object.frustumCulled = false;
      object.visible = !hidden.has(layer.name);
      scene.add(object);
      return { object, layer };
    });
    layers.replaceChildren(...shown.map(({ object, layer }) => {
      const label = document.createElement("label");
      const box = document.createElement("input");
      box.type = "checkbox";
      box.checked = object.visible;
      box.addEventListener("change", () => {
        object.visible = box.checked;
        if (box.checked) hidden.delete(layer.name); else hidden.add(layer.name);
        ask();
      });
      label.append(box);
      for (const [background, text] of layer.legend ?? [[layer.color, layer.name]]) {
        const swatch = document.createElement("span");
        swatch.className = background.startsWith("#") ? "swatch" : "swatch scale";
        swatch.style.background = background;
        label.append(...background ? [swatch, text] : [text]);
      }
      return label;
    }));
    ask();
  };
  const look = (from, at) => { camera.position.set(...from); controls.target = new Vector3(...at); ask(); };
  const target = () => scenes[select.value | 0].focus ?? [0, 0, 0];
  const places = {
    behind: () => look([-28, 0, 16], [12, 0, 0]),
    above: () => look([0, -0.1, 130], [0, 0, 0]),
    target: () => { const [x, y, z] = target(); look([x - 7, y - 7, z + 5], [x, y, z]); },
  };
  const select = root.querySelector("select");
  scenes.forEach((frame, i) => select.append(new Option(frame.name, i)));
  select.addEventListener("change", open);
  applied?.addEventListener("change", open);
  for (const button of root.querySelectorAll("button[data-view]")) {
    button.addEventListener("click", () => places[button.dataset.view]());
    button.hidden = button.dataset.view === "target" && scenes.every((frame) => !frame.focus);
  }
  controls.addEventListener("change", ask);
  new ResizeObserver(ask).observe(canvas);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", ask);
  open();
  places.behind();
}

for (const root of document.querySelectorAll(".viewer")) {
  const data = JSON.parse(document.getElementById(root.dataset.scene).textContent);
  if (data.scenes.length) view(root, data);
}
