// The page's script. Every layer is made here from what each vertex holds: how much of each endmember it sends (scaled
// abundances), its mixture (abundances), and gloss. `facts` has the spectra; `Kit` is three.js (three.js beside this file).
(async () => {
  "use strict";
  const $ = (id) => document.getElementById(id);
  const facts = JSON.parse($("data-facts").textContent);
  const make = (tag, fields = {}, ...inside) => {
    const element = Object.assign(document.createElement(tag), fields);
    element.append(...inside);
    return element;
  };
  const shownNumber = (value) => (Number.isFinite(value) ? String(+value.toPrecision(4)) : "undefined");
  document.documentElement.dataset.theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";

  const canvas = make("canvas", { tabIndex: 0 });
  canvas.setAttribute("aria-label", "The object in 3-D. Drag to turn it, click for a spectrum.");
  const context = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!context || !("DecompressionStream" in window)) {
    $("trouble").textContent =
      "This browser can't draw in 3-D (it has no WebGL 2). Open the page in a current browser; here are pictures instead.";
    return;
  }

  // ---- data ---------------------------------------------------------------------------------------------------------
  const bytes = Uint8Array.from(atob($("data-arrays").textContent), (letter) => letter.charCodeAt(0));
  $("data-arrays").remove();
  const unzipped = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(unzipped).arrayBuffer();
  const types = { u1: Uint8Array, i1: Int8Array, u2: Uint16Array, i2: Int16Array, i4: Int32Array };
  const read = (name) => {
    const how = facts.arrays[name];
    if (!how) return null;
    const stored = new types[how.type](buffer, how.start, how.count);
    if (!how.scale && !how.scales) return stored;
    return Float32Array.from(stored, (value, index) => {
      const scale = how.scales ? how.scales[index % how.width] : how.scale;
      return how.is_root ? scale * value * value : scale * value;
    });
  };
  const [positions, materials, confidence] = ["positions", "materials", "confidence"].map(read);
  const [scaled, abundances, gloss, tints] = ["scaled", "abundances", "gloss", "tints"].map(read);
  // Of objects whose light can be exchanged: `relit` says how the rest is meant.
  const relit = facts.relit;
  const [base, polish, normals, transfer, mirrored, tones] = ["base", "polish", "normals", "transfer", "mirrored", "tones"].map(read);
  const lit = read("lit") ?? base; // the base colour of what is lit in place of the material
  const faces = Uint32Array.from(read("faces"));
  for (let i = 1; i < faces.length; i++) faces[i] += faces[i - 1];
  const offset = facts.arrays.positions.offset;
  const [V, K, J, B] = [positions.length / 3, facts.names.length, facts.specular.length, facts.wavelengths_nm.length];
  const names = [...facts.names];
  const isWhite = relit || (facts.light && Math.max(...facts.light) - Math.min(...facts.light) < 1e-6);
  const colours = facts.colours.map((colour) => [...colour]);
  const tinted = new Set();
  const hidden = new Set();
  let metresPerUnit = facts.metres_per_unit;

  // ---- colour -------------------------------------------------------------------------------------------------------
  const toLinear = (value) => (value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4);
  const toDisplay = (value) => (value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055);
  const css = (colour) => `rgb(${colour.map((part) => Math.round(255 * Math.min(Math.max(part, 0), 1))).join(" ")})`;
  const hex = (colour) =>
    "#" + colour.map((part) => Math.round(255 * Math.min(Math.max(part, 0), 1)).toString(16).padStart(2, "0")).join("");
  const mapColour = (part) => facts.colour_map[Math.round(255 * Math.min(Math.max(part, 0), 1))].map((v) => v / 255);
  const luminance = (rgb) => 0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2];
  const throughMatrix = (spectra, matrix) =>
    spectra.map((spectrum) => [0, 1, 2].map((c) => spectrum.reduce((sum, value, b) => sum + value * matrix[b][c], 0)));
  const bandsAsColour = (bands) => facts.wavelengths_nm.map((_, b) => bands.map((band) => (band === b ? 1 : 0)));

  // A spectrum (B) at a vertex's coefficients; `from` is the unit vector to the eye, or null without gloss.
  const spectrumOf = (corners, weights, from) => {
    const spectrum = new Array(B).fill(0);
    corners.forEach((v, corner) => {
      for (let k = 0; k < K; k++) {
        const part = weights[corner] * scaled[v * K + k];
        if (part) facts.endmembers[k].forEach((value, b) => (spectrum[b] += part * value));
      }
      if (!from || !gloss) return;
      const strength = weights[corner] * glossAt(v, from);
      for (let j = 0; j < J; j++) facts.specular[j].forEach((value, b) => (spectrum[b] += strength * tints[v * J + j] * value));
    });
    return spectrum;
  };
  const glossAt = (v, [x, y, z]) => {
    const basis = [1, x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1];
    return Math.max(0, basis.reduce((sum, value, i) => sum + value * gloss[9 * v + i], 0));
  };
  const reflectanceOf = (spectrum) =>
    facts.light ? spectrum.map((value, b) => (facts.light[b] > 0 ? value / facts.light[b] : NaN)) : spectrum;

  // ---- index formulas: numbers, r800, + - * / ^ **, parentheses, sqrt log exp abs min max ------------------------------
  const parseFormula = (text) => {
    const tokens = text.toLowerCase().match(/\d+\.?\d*(?:e[+-]?\d+)?|\.\d+|[a-z_][a-z0-9_.]*|\*\*|\S/g) || [];
    let at = 0;
    const fail = (what) => { throw new Error(`${what}; allowed are numbers, r800 (the reflectance at 800 nm), + - * / ^, parentheses, sqrt log exp abs min max`); };
    const expect = (sign) => tokens[at++] === sign || fail(`${sign} is missing`);
    const functions = new Map(Object.entries({ sqrt: [Math.sqrt, 1], log: [Math.log, 1], exp: [Math.exp, 1], abs: [Math.abs, 1], min: [Math.min, 2], max: [Math.max, 2] }));
    const finite = (value) => (Number.isFinite(value) ? value : NaN);
    const operand = () => {
      const token = tokens[at++];
      if (token === undefined) fail("the formula ends too early");
      if (token === "(") { const inner = sum(); expect(")"); return inner; }
      if (/^[\d.]/.test(token)) { const value = Number(token); return () => value; }
      if (/^r\d+(\.\d+)?$/.test(token)) return reflectanceAt(Number(token.slice(1)));
      if (!functions.has(token)) fail(`${token} is unknown`);
      const [apply, least] = functions.get(token);
      expect("(");
      const values = [sum()];
      while (tokens[at] === ",") { at++; values.push(sum()); }
      expect(")");
      if (least === 1 ? values.length !== 1 : values.length < 2) fail(`${token} takes ${least === 1 ? "one value" : "two values or more"}`);
      return (r) => finite(apply(...values.map((value) => value(r))));
    };
    const power = () => {
      const base = operand();
      if (tokens[at] !== "**" && tokens[at] !== "^") return base;
      at++;
      const exponent = sign();
      // The zeros carry what is undefined: alone, NaN ** 0 is 1.
      return (r) => finite(base(r) ** exponent(r) + 0 * base(r) + 0 * exponent(r));
    };
    const sign = () => {
      if (tokens[at] === "-") { at++; const inner = sign(); return (r) => -inner(r); }
      return power();
    };
    const chain = (next, signs) => () => {
      let left = next();
      while (signs.has(tokens[at])) {
        const [apply, before] = [signs.get(tokens[at++]), left];
        const right = next();
        left = (r) => finite(apply(before(r), right(r)));
      }
      return left;
    };
    const product = chain(sign, new Map([["*", (a, b) => a * b], ["/", (a, b) => a / b]]));
    const sum = chain(product, new Map([["+", (a, b) => a + b], ["-", (a, b) => a - b]]));
    const formula = sum();
    if (at < tokens.length) fail(`${tokens[at]} is not expected there`);
    return formula;
  };
  const usedBands = new Set();
  const reflectanceAt = (nm) => {
    const centres = facts.wavelengths_nm;
    if (nm < facts.edges_nm[0] || nm > facts.edges_nm[B]) throw new Error(`${nm} nm is outside the bands`);
    let right = centres.findIndex((centre) => centre >= nm);
    if (right < 0) right = B - 1;
    const left = centres[right] <= nm || right === 0 ? right : right - 1;
    [left, right].forEach((band) => usedBands.add(band));
    const part = left === right ? 0 : (nm - centres[left]) / (centres[right] - centres[left]);
    return (r) => r[left] + part * (r[right] - r[left]);
  };

  // ---- scene --------------------------------------------------------------------------------------------------------
  const renderer = new Kit.WebGLRenderer({ canvas, context, antialias: true, preserveDrawingBuffer: true });
  const scene = new Kit.Scene();
  // Gloss of a smooth or rough surface in light from far away, which `mirrored` has for each direction and roughness
  // (split sum; the share that a lobe reflects after Karis 2014), and the numbers that a display gets for light.
  const reflecting = relit && `
      precision highp sampler3D; uniform sampler3D mirrored, tones; varying vec3 across, eye, head_on, finish;
      vec3 reflected() {
        vec3 n = normalize(across), v = normalize(eye), r = reflect(-v, n);
        float facing = max(dot(n, v), 0.), layers = ${relit.map[2]}.;
        vec3 place = vec3(0.5 - (atan(r.y, r.x) - turn) / 6.2831853, acos(clamp(r.z, -1., 1.)) / 3.1415927, (finish.x * (layers - 1.) + 0.5) / layers);
        vec4 k = finish.x * vec4(-1., -0.0275, -0.572, 0.022) + vec4(1., 0.0425, 1.04, -0.04);
        float low = min(k.x * k.x, exp2(-9.28 * facing)) * k.x + k.y;
        return finish.z * texture(mirrored, place).rgb * (head_on * (k.z - 1.04 * low) + k.w + 1.04 * low);
      }
      vec3 toned(vec3 light) {
        vec3 steps = (log2(max(light, 1e-9)) - ${relit.stops[0].toFixed(1)}) / ${(relit.stops[1] - relit.stops[0]).toFixed(1)};
        return texture(tones, (clamp(steps, 0., 1.) * ${relit.tones - 1}. + 0.5) / ${relit.tones}.).rgb;
      }`;
  const camera = new Kit.PerspectiveCamera(40, 1, 0.01, 1000);
  camera.up.fromArray(facts.up);
  const geometry = new Kit.BufferGeometry();
  const attribute = (name, width, values = new Float32Array(width * V)) =>
    geometry.setAttribute(name, new Kit.BufferAttribute(values, width)).getAttribute(name);
  attribute("position", 3, positions);
  geometry.setIndex(new Kit.BufferAttribute(faces, 1));
  const [lightOf, tintOf, shownOf] = [attribute("light", 3), attribute("tint", 3), attribute("shown", 1)];
  if (gloss) [0, 3, 6].forEach((first) => attribute(`gloss${first}`, 3, Float32Array.from({ length: 3 * V }, (_, i) => gloss[9 * Math.floor(i / 3) + first + (i % 3)])));
  if (relit) [["normal", normals, 3], ["base", lit, 3], ["polish", polish, 3]].forEach(([name, values, width]) => attribute(name, width, values));
  const volume = (values, sizes, type) => {
    const texture = Object.assign(new Kit.Data3DTexture(values, ...sizes), { type, minFilter: Kit.LinearFilter, magFilter: Kit.LinearFilter, needsUpdate: true });
    if (type === Kit.HalfFloatType) texture.wrapS = Kit.RepeatWrapping; // directions go round
    return texture;
  };
  const mapSize = relit && 4 * relit.map[0] * relit.map[1] * relit.map[2];
  const reflections = relit && facts.lights.map((_, i) => volume(mirrored.slice(i * mapSize, (i + 1) * mapSize), relit.map, Kit.HalfFloatType));
  const surface = new Kit.ShaderMaterial({
    side: Kit.DoubleSide,
    uniforms: {
      gain: { value: 1 }, glossy: { value: 0 }, flat_: { value: 0 }, turn: { value: 0 }, mirrored: { value: relit && reflections[0] },
      tones: { value: relit && volume(tones, [relit.tones, relit.tones, relit.tones], Kit.UnsignedByteType) },
    },
    vertexShader: `
      attribute vec3 light, tint${gloss ? ", gloss0, gloss3, gloss6" : ""}; attribute float shown;
      uniform float glossy; varying vec3 sent; varying float there;
      ${relit ? "attribute vec3 base, polish; varying vec3 across, eye, head_on, finish;" : ""}
      void main() {
        ${relit ? "across = normal; eye = cameraPosition - position; finish = polish; head_on = mix(vec3(0.04), base, polish.y);" : ""}
        vec3 d = normalize(cameraPosition - position);
        float strength = ${gloss ? `dot(gloss0, vec3(1., d.x, d.y)) + dot(gloss3, vec3(d.z, d.x * d.y, d.y * d.z))
          + dot(gloss6, vec3(d.x * d.z, d.x * d.x - d.y * d.y, 3. * d.z * d.z - 1.))` : "0."};
        sent = light + glossy * max(strength, 0.) * tint; there = shown;
        gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.);
      }`,
    fragmentShader: `
      uniform float gain, flat_, glossy, turn; varying vec3 sent; varying float there;
      ${relit ? reflecting : ""}
      void main() {
        if (there < 0.5) discard;
        ${relit ? "if (glossy > 0.) { gl_FragColor = vec4(toned((sent + reflected()) * gain), 1.); return; }" : ""}
        vec3 linear = clamp(sent * gain, 0., 1.);
        vec3 curved = mix(12.92 * linear, 1.055 * pow(max(linear, 1e-6), vec3(1. / 2.4)) - 0.055, step(0.0031308, linear));
        gl_FragColor = vec4(mix(curved, sent, flat_), 1.);
      }`,
  });
  const object = new Kit.Mesh(geometry, surface);
  scene.add(object);
  geometry.computeBoundingSphere();
  const sphere = geometry.boundingSphere;
  const controls = new Kit.OrbitControls(camera, canvas);
  controls.listenToKeyEvents(canvas);
  controls.maxDistance = 40 * sphere.radius;
  const marks = new Kit.Group();
  scene.add(marks);

  let isStale = true;
  const redraw = () => { isStale = true; };
  controls.addEventListener("change", redraw);
  const frame = () => {
    requestAnimationFrame(frame);
    if (!isStale) return;
    isStale = false;
    draw();
  };
  const draw = () => {
    const [width, height] = [innerWidth, innerHeight];
    const size = renderer.getSize(new Kit.Vector2());
    if (size.x !== width || size.y !== height) {
      renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
    }
    // The object stands in the middle of what the panel leaves free.
    const [panel, isPhone] = [$("panel"), width <= 700];
    const isOpen = !panel.hidden && !panel.classList.contains("folded");
    const [right, below] = [isOpen && !isPhone ? panel.offsetWidth : 0, isOpen && isPhone ? panel.offsetHeight : 0];
    camera.zoom = Math.min(width - right, height - below) / Math.min(width, height);
    const distance = camera.position.distanceTo(sphere.center);
    [camera.near, camera.far] = [Math.max(distance - 2 * sphere.radius, distance / 1000), distance + 2 * sphere.radius];
    camera.setViewOffset(width, height, right / 2, below / 2, width, height);
    renderer.setClearColor(new Kit.Color(getComputedStyle(document.body).backgroundColor));
    renderer.render(scene, camera);
    drawScaleBar(height);
  };
  addEventListener("resize", redraw);
  new ResizeObserver(redraw).observe($("panel"));

  const lookFrom = (position, target) => {
    camera.position.copy(position);
    controls.target.copy(target);
    controls.update();
    redraw();
  };
  const wholeObject = () => {
    const first = facts.cameras[0] ? new Kit.Vector3(...facts.cameras[0].position).sub(new Kit.Vector3(...offset)) : new Kit.Vector3(1, 1, 1);
    camera.fov = 40;
    const narrow = Math.min(1, innerWidth / innerHeight);
    const distance = sphere.radius / Math.sin((camera.fov * Math.PI) / 360) / narrow;
    lookFrom(first.sub(sphere.center).setLength(distance).add(sphere.center), sphere.center);
  };
  const lookThrough = (index) => {
    const view = facts.cameras[index];
    const position = new Kit.Vector3(...view.position).sub(new Kit.Vector3(...offset));
    const back = new Kit.Vector3(...view.axes[2]);
    camera.fov = (360 / Math.PI) * Math.atan(view.size[1] / 2 / view.focal_px[1]);
    const reach = Math.max(position.clone().sub(sphere.center).dot(back), sphere.radius / 10);
    lookFrom(position, position.clone().addScaledVector(back, -reach));
  };

  // ---- layers -------------------------------------------------------------------------------------------------------
  const state = { layer: "colour", band: Math.floor(B / 2), false: [5, 3, 1].map((part) => Math.floor((part * B) / 6)), material: 0, index: 0, formula: "" };
  const layers = [
    ["colour", relit ? "colour in a light" : "true colour"], ...(relit ? [["base", "base colour"], ["roughness", "roughness"], ["metallicity", "metallicity"]] : []),
    ...(B ? [["band", "one band"], ["false", "false colour"], ["abundance", "abundance of a material"], ["materials", "materials"]] : []),
    ...(confidence ? [["confidence", "confidence in the material"]] : []), ...(B ? [["index", "spectral index"]] : []),
  ];
  const litLayers = relit ? ["colour"] : ["colour", "band", "false"];
  layers.forEach(([value, text]) => $("layer").append(make("option", { value, text })));
  facts.lights.forEach((light, value) => $("light").append(make("option", { value, text: light.name })));

  const paintLight = (matrix) => {
    const factors = facts.lights[relit ? 0 : $("light").value].factors;
    const lit = (spectra) => spectra.map((spectrum) => spectrum.map((value, b) => value * factors[b]));
    const sent = throughMatrix(lit(facts.endmembers), matrix);
    tinted.forEach((k) => {
      const tint = colours[k].map(toLinear);
      const strength = luminance(sent[k]) / Math.max(luminance(tint), 1e-4);
      if (state.layer === "colour") sent[k] = tint.map((part) => part * strength);
    });
    const mirrored = J ? throughMatrix(lit(facts.specular), matrix) : [];
    const [light, tint] = [lightOf.array, tintOf.array];
    for (let v = 0; v < V; v++)
      for (let c = 0; c < 3; c++) {
        let sum = 0;
        for (let k = 0; k < K; k++) sum += scaled[v * K + k] * sent[k][c];
        light[3 * v + c] = sum;
        sum = 0;
        for (let j = 0; j < J; j++) sum += tints[v * J + j] * mirrored[j][c];
        tint[3 * v + c] = sum;
      }
    lightOf.needsUpdate = tintOf.needsUpdate = true;
    surface.uniforms.flat_.value = 0;
    surface.uniforms.gain.value = relit ? 1 : 2 ** Number($("exposure").value);
    surface.uniforms.glossy.value = gloss && $("gloss").checked ? 1 : 0;
  };
  // Light from far away as 16 spherical harmonics, turned about the vertical; `transfer` is what of them arrives.
  const paintRelit = () => {
    const [light, angle] = [facts.lights[$("light").value], (Number($("turn").value) * Math.PI) / 180];
    const turned = light.harmonics.map((value, i) => {
      const l = Math.floor(Math.sqrt(i)), m = i - l * l - l;
      const [cos, sin, other] = [Math.cos(m * angle), Math.sin(m * angle), light.harmonics[i - 2 * m]];
      return value.map((part, c) => part * cos - other[c] * sin);
    });
    for (let v = 0; v < V; v++)
      for (let c = 0; c < 3; c++) {
        let sum = 0;
        for (let i = 0; i < 16; i++) sum += transfer[16 * v + i] * turned[i][c];
        lightOf.array[3 * v + c] = 0.95 * Math.max(sum, 0) * lit[3 * v + c] * (1 - polish[3 * v + 1]); // 5 % stay in the gloss
      }
    lightOf.needsUpdate = true;
    const uniforms = surface.uniforms;
    [uniforms.gain.value, uniforms.glossy.value, uniforms.turn.value] = [2 ** Number($("exposure").value), 1, angle];
    uniforms.mirrored.value = reflections[$("light").value];
    return facts.colour;
  };
  const paintBase = () => {
    if (B) paintLight(facts.rgb);
    else lightOf.array.set(base);
    lightOf.needsUpdate = true;
    [surface.uniforms.flat_.value, surface.uniforms.gain.value, surface.uniforms.glossy.value] = [0, 1, 0];
    return "what the surface reflects of white light, without gloss";
  };
  const paintValues = (valueOf, low, high) => {
    for (let v = 0; v < V; v++) {
      const value = valueOf(v);
      lightOf.array.set(Number.isFinite(value) ? mapColour((value - low) / (high - low)) : [0.6, 0.6, 0.6], 3 * v);
    }
    paintedFlat();
    const stops = Array.from({ length: 9 }, (_, i) => css(mapColour(i / 8))).join(",");
    const bar = make("div", { className: "bar" });
    bar.style.background = `linear-gradient(to right,${stops})`;
    const ends = [low, (low + high) / 2, high].map((value) => make("span", { textContent: shownNumber(value) }));
    $("legend").replaceChildren(bar, make("div", { className: "ends" }, ...ends));
  };
  const paintedFlat = () => {
    lightOf.needsUpdate = true;
    surface.uniforms.flat_.value = 1;
    surface.uniforms.glossy.value = 0;
  };
  const swatch = (k) => {
    const dot = make("span", { className: "dot" });
    dot.style.background = css(colours[k]);
    return make("div", { className: "key" }, dot, `${names[k]}: ${unitText(Math.sqrt(facts.areas[k]), 2)}`);
  };

  const painters = {
    colour: () => { if (relit) return paintRelit(); paintLight(facts.rgb); return facts.colour; },
    base: paintBase,
    roughness: () => { paintValues((v) => polish[3 * v], 0, 1); return "roughness of the gloss, 0 (a mirror) to 1"; },
    metallicity: () => { paintValues((v) => polish[3 * v + 1], 0, 1); return "0 (no metal) to 1 (bare metal)"; },
    band: () => {
      paintLight(bandsAsColour([state.band, state.band, state.band]));
      return `${isWhite ? "reflectance" : "radiance"} at ${facts.wavelengths_nm[state.band]} nm${isWhite ? "" : ", 1 = full scale"}, shown as grey`;
    },
    false: () => {
      paintLight(bandsAsColour(state.false));
      return `red, green, blue show ${state.false.map((b) => facts.wavelengths_nm[b]).join(", ")} nm`;
    },
    abundance: () => { paintValues((v) => abundances[v * K + state.material], 0, 1); return `share of ${names[state.material]} in what is seen, 0 to 1`; },
    materials: () => {
      for (let v = 0; v < V; v++) lightOf.array.set(colours[materials[v]] || [0.6, 0.6, 0.6], 3 * v);
      paintedFlat();
      const present = new Set(materials);
      $("legend").replaceChildren(...names.map((_, k) => k).filter((k) => present.has(k)).map(swatch));
      return "the material with the largest share at each place, and the area of the surface that it covers";
    },
    confidence: () => { paintValues((v) => confidence[v], 0, 1); return "estimated probability that the material is right"; },
    index: () => {
      const known = facts.indices[state.index];
      const text = state.formula || known?.formula || "";
      usedBands.clear();
      const formula = parseFormula(text);
      const values = new Float32Array(V);
      const reflectance = new Array(B).fill(NaN);
      for (let v = 0; v < V; v++) {
        for (const b of usedBands) {
          reflectance[b] = 0;
          for (let k = 0; k < K; k++) reflectance[b] += scaled[v * K + k] * facts.endmembers[k][b];
          if (facts.light) reflectance[b] = facts.light[b] > 0 ? reflectance[b] / facts.light[b] : NaN;
        }
        values[v] = formula(reflectance);
      }
      const finite = values.filter(Number.isFinite).sort();
      if (!finite.length) throw new Error("the formula is undefined everywhere");
      let [low, high] = state.formula ? [finite[Math.floor(finite.length / 100)], finite[Math.floor(finite.length * 0.99)]] : known.range;
      if (!(high > low)) high = low + 1;
      paintValues((v) => values[v], low, high);
      const of = facts.light ? "" : "; of radiance, since the light is unknown";
      return (state.formula ? text : `${known.title}, ${text}`) + of;
    },
  };
  const paint = () => {
    try {
      $("legend").replaceChildren();
      $("about").textContent = painters[state.layer]();
    } catch (error) {
      lightOf.array.fill(0.6);
      paintedFlat();
      $("about").textContent = error.message;
    }
    const notes = facts.lights[$("light").value].notes;
    if (litLayers.includes(state.layer) && notes.length) $("about").textContent += ". " + notes.join(". ");
    for (let v = 0; v < V; v++) {
      let share = 1;
      hidden.forEach((k) => (share -= abundances[v * K + k]));
      shownOf.array[v] = share;
    }
    shownOf.needsUpdate = true;
    redraw();
  };

  const chooser = (text, options, value, change) => {
    const select = make("select", { onchange: () => { change(Number(select.value)); paint(); } });
    options.forEach((option, index) => select.append(make("option", { value: index, text: option })));
    select.value = value;
    return [make("label", {}, text, select)];
  };
  const slider = (text, value, change) => {
    const label = make("span", { textContent: facts.wavelengths_nm[value] });
    const input = make("input", { type: "range", min: 0, max: B - 1, step: 1, value });
    input.oninput = () => { label.textContent = facts.wavelengths_nm[input.value]; change(Number(input.value)); paint(); };
    return [make("label", {}, `${text} `, label, " nm", input)];
  };
  const showArguments = () => {
    const formula = make("input", { type: "text", placeholder: "(r800-r670)/(r800+r670)", value: state.formula, maxLength: 500 });
    formula.onchange = () => { state.formula = formula.value.trim(); paint(); };
    const choices = {
      band: () => slider("Wavelength", state.band, (b) => (state.band = b)),
      false: () => ["Red", "Green", "Blue"].flatMap((name, c) => slider(name, state.false[c], (b) => (state.false[c] = b))),
      abundance: () => chooser("Material", names, state.material, (k) => (state.material = k)),
      index: () => [
        ...(facts.indices.length ? chooser("Index", facts.indices.map((one) => `${one.name}: ${one.title}`), state.index, (i) => { state.index = i; state.formula = formula.value = ""; }) : []),
        make("label", {}, "Or a formula of reflectances", formula),
      ],
    };
    $("arguments").replaceChildren(...(choices[state.layer]?.() ?? []));
    $("lit").hidden = !litLayers.includes(state.layer);
    $("turning").hidden = !relit;
    $("gloss").parentElement.hidden = !gloss;
  };
  const choose = (layer) => { state.layer = $("layer").value = layer; showArguments(); paint(); };
  $("layer").onchange = () => choose($("layer").value);
  $("light").onchange = $("gloss").onchange = $("turn").oninput = paint;
  $("exposure").oninput = () => { $("stops").textContent = $("exposure").value; paint(); };

  // ---- materials ----------------------------------------------------------------------------------------------------
  const listMaterials = () => {
    $("materials").replaceChildren(...names.map((name, k) => {
      const shown = make("input", { type: "checkbox", checked: !hidden.has(k), title: "show or hide" });
      shown.onchange = () => { shown.checked ? hidden.delete(k) : hidden.add(k); paint(); };
      const colour = make("input", { type: "color", value: hex(colours[k]), title: "another colour, in the legend and in true colour" });
      colour.oninput = () => { colours[k] = [1, 3, 5].map((i) => parseInt(colour.value.slice(i, i + 2), 16) / 255); tinted.add(k); paint(); };
      const text = make("input", { type: "text", value: name, maxLength: 100, title: "rename" });
      text.onchange = () => { names[k] = text.value.trim() || facts.names[k]; showArguments(); paint(); listPoints(); };
      return make("div", { className: "material" }, shown, colour, text, make("p", { className: "note", textContent: `like ${facts.known[k][0] ?? "nothing known"}`, title: facts.known[k].join(", ") }));
    }));
  };

  // ---- points -------------------------------------------------------------------------------------------------------
  const points = [];
  const markColours = ["#e6550d", "#3182bd", "#31a354", "#756bb1", "#d62790", "#8c6d31", "#17a2b8", "#777777"];
  let isMeasuring = false;
  const rulerEnds = [];
  const raycaster = new Kit.Raycaster();
  const pick = (x, y) => {
    geometry.boundsTree ??= new Kit.MeshBVH(geometry, { indirect: true });
    raycaster.setFromCamera(new Kit.Vector2((2 * x) / innerWidth - 1, 1 - (2 * y) / innerHeight), camera);
    for (const hit of raycaster.intersectObject(object)) {
      const corners = [hit.face.a, hit.face.b, hit.face.c];
      const triangle = corners.map((v) => new Kit.Vector3().fromArray(positions, 3 * v));
      const weights = Kit.Triangle.getBarycoord(hit.point, ...triangle, new Kit.Vector3())?.toArray();
      if (!weights) continue;
      const mean = (values, width, i) => corners.reduce((sum, v, c) => sum + weights[c] * values[v * width + i], 0);
      if (mean(shownOf.array, 1, 0) < 0.5) continue;
      const from = camera.position.clone().sub(hit.point).normalize().toArray();
      return {
        place: hit.point.clone(), spectrum: spectrumOf(corners, weights, from),
        mixture: names.map((_, k) => mean(abundances, K, k)),
        finish: relit && [...[0, 1, 2].map((c) => mean(base, 3, c)), mean(polish, 3, 0), mean(polish, 3, 1)],
      };
    }
    return null;
  };
  const angle = (a, b) => {
    const dot = (p, q) => p.reduce((sum, value, i) => sum + value * q[i], 0);
    return Math.acos(Math.min(1, dot(a, b) / Math.sqrt(Math.max(dot(a, a) * dot(b, b), 1e-30))));
  };
  const world = (place) => place.toArray().map((value, axis) => value + offset[axis]);
  const markAt = (place, colour) => {
    const dot = new Kit.Mesh(new Kit.SphereGeometry(sphere.radius / 90, 16, 12), new Kit.MeshBasicMaterial({ color: colour }));
    dot.position.copy(place);
    return dot;
  };
  const showMarks = () => {
    marks.clear();
    points.forEach((point) => marks.add(markAt(point.place, point.colour)));
    rulerEnds.forEach((place) => marks.add(markAt(place, "#ffb000")));
    if (rulerEnds.length === 2)
      marks.add(new Kit.Line(new Kit.BufferGeometry().setFromPoints(rulerEnds), new Kit.LineBasicMaterial({ color: "#ffb000", depthTest: false })));
    redraw();
  };
  const listPoints = () => {
    $("how").hidden = points.length > 0;
    const rows = points.map((point, index) => {
      const dot = make("span", { className: "dot" });
      dot.style.background = point.colour;
      const mixture = point.mixture.map((share, k) => [share, k]).filter(([share]) => share >= 0.02).sort((a, b) => b[0] - a[0]);
      const shares = mixture.slice(0, 4).map(([share, k]) => `${names[k]} ${Math.round(100 * share)} %`).join(", ");
      const at = `At ${world(point.place).map(shownNumber).join(", ")}.`;
      const finish = relit ? `base colour ${hex(point.finish.slice(0, 3).map(toDisplay))}, roughness ${point.finish[3].toFixed(2)}, metallicity ${point.finish[4].toFixed(2)}. ` : "";
      if (!B) return make("div", { className: "key" }, dot, make("span", { textContent: `${index + 1}: ${finish}${at}` }));
      const nearest = facts.endmembers.map((spectrum, k) => [angle(spectrum, point.spectrum), k]).sort((a, b) => a[0] - b[0])[0];
      const like = facts.known[nearest[1]][0];
      const text = `${index + 1}: ${shares || "nothing"}. Nearest: ${names[nearest[1]]}, ${nearest[0].toFixed(3)} rad${like ? `, like ${like}` : ""}. ${finish}${at}`;
      return make("div", { className: "key" }, dot, make("span", { textContent: text }));
    });
    $("points").replaceChildren(...(points.length && B ? [chart()] : []), ...rows);
  };
  const chart = () => {
    const shown = points.map((point) => reflectanceOf(point.spectrum));
    const [left, right, top, bottom] = [34, 300, 8, 140];
    const nm = facts.wavelengths_nm;
    const most = Math.max(1e-6, ...shown.flat().filter(Number.isFinite));
    const x = (value) => left + ((value - nm[0]) / Math.max(nm[B - 1] - nm[0], 1e-9)) * (right - left);
    const y = (value) => bottom - (value / most) * (bottom - top);
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    const draw = (tag, fields, text = "") => {
      const element = document.createElementNS(svg.namespaceURI, tag);
      Object.entries(fields).forEach(([name, value]) => element.setAttribute(name, value));
      element.textContent = text;
      svg.append(element);
    };
    svg.setAttribute("viewBox", "0 0 306 172");
    draw("path", { d: `M${left} ${top}V${bottom}H${right}`, fill: "none", stroke: "currentColor", "stroke-opacity": 0.4 });
    [0, 0.5, 1].forEach((part) => draw("text", { x: left - 4, y: y(part * most) + 3, "text-anchor": "end" }, (part * most).toPrecision(2)));
    [0, 0.5, 1].forEach((part) => {
      const value = nm[0] + part * (nm[B - 1] - nm[0]);
      draw("text", { x: x(value), y: bottom + 13, "text-anchor": part === 1 ? "end" : "middle" }, Math.round(value));
    });
    draw("text", { x: (left + right) / 2, y: bottom + 27, "text-anchor": "middle" }, `wavelength (nm); up: ${facts.light ? "reflectance" : "radiance, 1 = full scale"}`);
    shown.forEach((values, index) => {
      const line = values.map((value, b) => (Number.isFinite(value) ? `${x(nm[b]).toFixed(1)},${y(value).toFixed(1)}` : "")).join(" ");
      draw("polyline", { points: line, fill: "none", stroke: points[index].colour, "stroke-width": 1.8 });
    });
    return svg;
  };
  const save = (name, blob) => {
    const link = make("a", { href: URL.createObjectURL(blob), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  const quoted = (text) => `"${text.replaceAll('"', '""')}"`;
  const csvText = () => {
    const head = points.map((_, index) => `point ${index + 1}`);
    const rows = [["quantity", ...head]];
    ["x", "y", "z"].forEach((axis, i) => rows.push([axis, ...points.map((point) => world(point.place)[i])]));
    names.forEach((name, k) => rows.push([quoted(`abundance of ${name}`), ...points.map((point) => point.mixture[k])]));
    if (relit) ["base colour red", "base colour green", "base colour blue", "roughness", "metallicity"].forEach((what, i) => rows.push([what, ...points.map((point) => point.finish[i])]));
    const what = facts.light ? "reflectance" : "radiance";
    facts.wavelengths_nm.forEach((nm, b) => rows.push([`${what} at ${nm} nm`, ...points.map((point) => reflectanceOf(point.spectrum)[b])]));
    return rows.map((row) => row.join(",")).join("\r\n") + "\r\n";
  };
  $("csv").onclick = () => save("points.csv", new Blob([csvText()], { type: "text/csv" }));
  $("clear").onclick = () => { points.length = 0; rulerEnds.length = 0; showLength(); listPoints(); showMarks(); };

  // ---- lengths ------------------------------------------------------------------------------------------------------
  const unitText = (length, power = 1) => {
    const square = power === 2 ? "²" : "";
    if (metresPerUnit === null) return `${shownNumber(length ** power)} world ${length === 1 ? "unit" : "units"}${square}`;
    const metres = length * metresPerUnit;
    const [factor, unit] = metres >= 1 ? [1, "m"] : metres >= 0.01 ? [100, "cm"] : [1000, "mm"];
    return `${shownNumber((metres * factor) ** power)} ${unit}${square}`;
  };
  const showLength = () => {
    const isWhole = rulerEnds.length === 2;
    $("known").hidden = !isWhole;
    $("length").textContent = isWhole ? unitText(rulerEnds[0].distanceTo(rulerEnds[1])) : isMeasuring ? "click two points" : "";
  };
  const measure = (on) => { isMeasuring = on; $("hint").textContent = on ? "Click two points of the object." : ""; $("ruler").setAttribute("aria-pressed", on); if (on) rulerEnds.length = 0; showLength(); showMarks(); };
  $("ruler").onclick = () => measure(!isMeasuring);
  $("true-length").onchange = () => {
    const metres = Number($("true-length").value);
    const length = rulerEnds.length === 2 ? rulerEnds[0].distanceTo(rulerEnds[1]) : 0;
    if (!(metres > 0) || !(length > 0)) { $("length").textContent = "a length must be greater than 0"; return; }
    metresPerUnit = metres / length;
    showLength();
    paint();
  };
  const drawScaleBar = (height) => {
    const distance = camera.position.distanceTo(controls.target);
    const perPixel = (2 * distance * Math.tan((camera.fov * Math.PI) / 360)) / height / camera.zoom;
    const unit = metresPerUnit ?? 1;
    const widest = 220 * perPixel * unit;
    const power = 10 ** Math.floor(Math.log10(widest));
    const length = power * ([5, 2, 1].find((step) => step * power <= widest) ?? 1);
    $("scale").hidden = false;
    $("scale").style.width = `${length / unit / perPixel}px`;
    $("scale").textContent = unitText(length / unit);
  };

  // ---- hands and keys -----------------------------------------------------------------------------------------------
  let pressed = null;
  // A second finger begins a pinch, which picks nothing.
  canvas.addEventListener("pointerdown", (event) => { pressed = event.isPrimary ? [event.clientX, event.clientY] : null; });
  canvas.addEventListener("pointerup", (event) => {
    const from = pressed;
    pressed = null;
    if (!from || Math.hypot(event.clientX - from[0], event.clientY - from[1]) > 5 || event.button) return;
    const found = pick(event.clientX, event.clientY);
    if (!found) return;
    if (isMeasuring) {
      if (rulerEnds.length === 2) rulerEnds.length = 0;
      rulerEnds.push(found.place);
      showLength();
    } else {
      if (points.length === markColours.length) points.shift();
      const free = markColours.find((colour) => !points.some((point) => point.colour === colour));
      points.push({ ...found, colour: free });
      listPoints();
      if ($("panel").classList.contains("folded")) fold();
      if (innerWidth <= 700) $("points").scrollIntoView();
    }
    showMarks();
  });
  const theme = () => { const root = document.documentElement; root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark"; redraw(); };
  const fold = () => {
    const folded = $("panel").classList.toggle("folded");
    $("fold").textContent = folded ? "+" : "–";
    $("fold").setAttribute("aria-expanded", !folded);
    redraw();
  };
  $("theme").onclick = theme;
  $("fold").onclick = fold;
  const step = (by) => { if (state.layer === "band") { state.band = Math.min(Math.max(state.band + by, 0), B - 1); showArguments(); paint(); } };
  const keys = { 0: wholeObject, t: theme, p: fold, r: () => measure(!isMeasuring), "[": () => step(-1), "]": () => step(1), Escape: () => $("clear").click() };
  layers.forEach(([layer], index) => (keys[index + 1] = () => choose(layer)));
  addEventListener("keydown", (event) => {
    const isAlt = (event.ctrlKey || event.metaKey || event.altKey) && !event.getModifierState("AltGraph");
    if (isAlt || event.target.matches("select, input[type='text'], input[type='number']")) return;
    keys[event.key.length === 1 ? event.key.toLowerCase() : event.key]?.();
  });

  $("camera").append(make("option", { value: "", text: "choose a view" }));
  facts.cameras.forEach((view, value) => $("camera").append(make("option", { value, text: view.name })));
  $("camera").onchange = () => { if ($("camera").value) lookThrough(Number($("camera").value)); };
  controls.addEventListener("start", () => { $("camera").value = ""; });
  $("whole").onclick = wholeObject;
  $("picture").onclick = () => { draw(); canvas.toBlob((blob) => save("picture.png", blob)); };

  // ---- begin --------------------------------------------------------------------------------------------------------
  const about = [
    facts.subtitle, `${V.toLocaleString("en")} vertices, ${(faces.length / 3).toLocaleString("en")} triangles`,
    ...(B ? [
      `${B} bands, ${facts.wavelengths_nm[0]} to ${facts.wavelengths_nm[B - 1]} nm`,
      facts.light ? "spectra of points are reflectance" : "the light is unknown: spectra are radiance, 1 = full scale",
    ] : []),
    ...(facts.scale ? [`scale: ${facts.scale}`] : []), ...facts.notes, facts.made, "Keys: 1 to 7 layers, [ and ] bands, 0 whole object, R ruler, T light or dark, P panel, Esc clears; arrows move, with shift they turn.",
  ];
  $("facts").replaceChildren(...about.map((text) => make("p", { className: "note", textContent: text })));
  document.querySelector("#head h1").textContent = facts.title;
  $("fallback").before(canvas);
  $("panel").hidden = false;
  if (innerWidth <= 700) fold();
  document.body.classList.add("ready");
  listMaterials();
  $("materials").parentElement.hidden = !K;
  if (!B) $("how").textContent = "Click the object: its material appears here.";
  choose("colour");
  wholeObject();
  frame();
  window.unmixPage = { state, choose, lookThrough, wholeObject, pick, fold, csvText, facts, draw };
})();
