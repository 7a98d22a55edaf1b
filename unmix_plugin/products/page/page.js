// The page's script. Every layer is made here from what each vertex holds: how much of each endmember it sends (scaled
// abundances), its mixture (abundances), and gloss. `facts` has the spectra; `Kit` is three.js (three.js beside this file),
// `Spectra` what can be computed of spectra alone (spectra.js).
//
// Notation: V vertices, K endmembers, J specular spectra, B bands.
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
  const packed = $("data-arrays").textContent;
  $("data-arrays").textContent = ""; // kept once
  const untouched = document.documentElement.cloneNode(true); // the page as it came, for copies of it
  const letters = atob(packed);
  const bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  $("data-arrays").remove();
  const unzipped = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(unzipped).arrayBuffer();
  const types = { u1: Uint8Array, i1: Int8Array, u2: Uint16Array, i2: Int16Array, i4: Int32Array, f4: Float32Array };
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
  const [positions, materials, confidence, unexplained] = ["positions", "materials", "confidence", "unexplained"].map(read);
  const [areas, keptShares] = ["areas", "regions"].map(read);
  const [scaled, abundances, gloss, tints, halfWidths] = ["scaled", "abundances", "gloss", "tints", "half_widths"].map(read);
  // Of objects whose light can be exchanged: `relit` says how the rest is meant.
  const relit = facts.relit;
  const [base, polish, normals, transfer, mirrored, tones] = ["base", "polish", "normals", "transfer", "mirrored", "tones"].map(read);
  const lit = read("lit") ?? base; // the base colour of what is lit in place of the material
  const faces = Uint32Array.from(read("faces"));
  for (let i = 1; i < faces.length; i++) faces[i] += faces[i - 1];
  const offset = facts.arrays.positions.offset;
  const [V, K, J, B] = [positions.length / 3, facts.names.length, facts.specular.length, facts.wavelengths_nm.length];
  const names = [...facts.names];
  // Radiance is reflectance where the light shown is known to be 1 in every band.
  const isWhite = () => {
    const { factors } = facts.lights[$("light").value];
    return relit || (facts.is_light_known && facts.light.every((power, b) => Math.abs(power * factors[b] - 1) <= 1e-3));
  };
  const colours = facts.colours.map((colour) => [...colour]);
  const tinted = new Set();
  const hidden = new Set();
  let metresPerUnit = facts.metres_per_unit;
  const isLit = facts.is_lit; // nothing is known of the reflectance in other bands
  const UNKNOWN = 65535; // in what is stored of known spectra
  const stored = read("known");
  const known = facts.known.map((one, m) => ({
    ...one, reflectance: Array.from(stored.subarray(m * B, (m + 1) * B), (step) => (step === UNKNOWN ? NaN : step / (UNKNOWN - 1))),
  }));

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

  // A spectrum (B) at the coefficients of three vertices; `from` is the unit vector to the eye, or null without gloss.
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
    facts.light ? spectrum.map((value, b) => (isLit[b] ? value / facts.light[b] : NaN)) : spectrum;

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
  const markOf = attribute("mark", 4); // colour times share, and share, of the region that is shown there
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
      attribute vec3 light, tint${gloss ? ", gloss0, gloss3, gloss6" : ""}; attribute float shown; attribute vec4 mark;
      uniform float glossy; varying vec3 sent; varying float there; varying vec4 marked;
      ${relit ? "attribute vec3 base, polish; varying vec3 across, eye, head_on, finish;" : ""}
      void main() {
        ${relit ? "across = normal; eye = cameraPosition - position; finish = polish; head_on = mix(vec3(0.04), base, polish.y);" : ""}
        vec3 d = normalize(cameraPosition - position);
        float strength = ${gloss ? `dot(gloss0, vec3(1., d.x, d.y)) + dot(gloss3, vec3(d.z, d.x * d.y, d.y * d.z))
          + dot(gloss6, vec3(d.x * d.z, d.x * d.x - d.y * d.y, 3. * d.z * d.z - 1.))` : "0."};
        sent = light + glossy * max(strength, 0.) * tint; there = shown; marked = mark;
        gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.);
      }`,
    fragmentShader: `
      uniform float gain, flat_, glossy, turn; varying vec3 sent; varying float there; varying vec4 marked;
      ${relit ? reflecting : ""}
      vec3 painted() {
        ${relit ? "if (glossy > 0.) return toned((sent + reflected()) * gain);" : ""}
        vec3 linear = clamp(sent * gain, 0., 1.);
        vec3 curved = mix(12.92 * linear, 1.055 * pow(max(linear, 1e-6), vec3(1. / 2.4)) - 0.055, step(0.0031308, linear));
        return mix(curved, sent, flat_);
      }
      void main() {
        if (there < 0.5) discard;
        // Regions have an outline of three pixels where half of the surface is inside.
        bool isOutline = abs(marked.a - 0.5) < min(1.5 * fwidth(marked.a), 0.499);
        gl_FragColor = vec4(isOutline ? marked.rgb / max(marked.a, 1e-3) : painted(), 1.);
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
    placeLabels();
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
    const distance = (1.06 * sphere.radius) / Math.sin((camera.fov * Math.PI) / 360) / narrow;
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
    ["colour", relit ? "colour in a light" : facts.colour.startsWith("true") ? "true colour" : "false colour of all bands"], ...(relit ? [["base", "base colour"], ["roughness", "roughness"], ["metallicity", "metallicity"]] : []),
    ...(B ? [["band", "one band"], ["false", "false colour"], ["abundance", "abundance of a material"], ["materials", "materials"]] : []),
    ...(confidence ? [["confidence", "confidence in the material"]] : []), ...(unexplained ? [["unexplained", "what no material explains"]] : []), ...(B ? [["index", "spectral index"]] : []),
  ];
  const litLayers = relit ? ["colour"] : ["colour", "band", "false"];
  layers.forEach(([value, text]) => $("layer").append(make("option", { value, text })));
  facts.lights.forEach((light, value) => $("light").append(make("option", { value, text: light.title ?? light.name })));

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
    return make("div", { className: "key" }, dot, `${names[k]}: ${areaText(materialAreas[k])}`);
  };
  const materialAreas = new Float64Array(K);
  if (materials) areas.forEach((area, v) => { if (materials[v] < K) materialAreas[materials[v]] += area; });

  const painters = {
    colour: () => { if (relit) return paintRelit(); paintLight(facts.rgb); return facts.colour; },
    base: paintBase,
    roughness: () => { paintValues((v) => polish[3 * v], 0, 1); return "roughness of the gloss, 0 (a mirror) to 1"; },
    metallicity: () => { paintValues((v) => polish[3 * v + 1], 0, 1); return "0 (no metal) to 1 (bare metal)"; },
    band: () => {
      paintLight(bandsAsColour([state.band, state.band, state.band]));
      return `${isWhite() ? "reflectance" : "radiance"} at ${facts.wavelengths_nm[state.band]} nm${isWhite() ? "" : ", 1 = full scale"}, shown as grey`;
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
      return "the material of each place, and the area of the surface that it covers";
    },
    confidence: () => { paintValues((v) => confidence[v], 0, 1); return "estimated probability that the material is right"; },
    unexplained: () => {
      paintValues((v) => unexplained[v], 0, 0.2);
      return "part of the measured spectrum that no mixture of the materials gives, 0 to 0.2 and more; 0 where too few views see";
    },
    index: () => {
      const known = facts.indices[state.index];
      const text = state.formula || known?.formula || "";
      const formula = Spectra.parseFormula(text, facts.wavelengths_nm, facts.ranges_nm);
      const values = new Float32Array(V);
      const reflectance = new Array(B).fill(NaN);
      for (let v = 0; v < V; v++) {
        for (const b of formula.bands) {
          reflectance[b] = 0;
          for (let k = 0; k < K; k++) reflectance[b] += scaled[v * K + k] * facts.endmembers[k][b];
          if (facts.light) reflectance[b] = isLit[b] ? reflectance[b] / facts.light[b] : NaN;
        }
        values[v] = formula.value(reflectance);
      }
      const finite = values.filter(Number.isFinite).sort();
      if (!finite.length) throw new Error("the formula is undefined everywhere");
      let [low, high] = state.formula ? [finite[Math.floor(finite.length / 100)], finite[Math.floor(finite.length * 0.99)]] : known.range;
      if (!(high > low)) high = low + 1;
      paintValues((v) => values[v], low, high);
      const of = facts.is_light_known ? "" : "; of radiance, since the light is unknown";
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
      text.onchange = () => { names[k] = text.value.trim() || facts.names[k]; showArguments(); paint(); listProbes(); };
      const like = likeness(facts.endmembers[k]).map((match) => match.text);
      const note = make("p", { className: "note", textContent: `like ${like[0] ?? "nothing known"}`, title: like.join("\n") });
      return make("div", { className: "material" }, shown, colour, text, note);
    }));
  };

  // ---- what is known ------------------------------------------------------------------------------------------------
  const ALIKE_RAD = 0.1; // a larger angle is no match
  const likeness = (spectrum) =>
    Spectra.nearest(reflectanceOf(spectrum), known.map((one) => one.reflectance), 3).map(({ index, angle }) => {
      const { name, source } = known[index];
      const text = `${name} (${angle.toFixed(3)} rad${angle > ALIKE_RAD ? ", not alike" : ""}; ${source})`;
      return { ...known[index], angle, text };
    });

  // ---- picking ------------------------------------------------------------------------------------------------------
  const raycaster = new Kit.Raycaster();
  // Of what vertices hold, the mean at a point of a triangle.
  const meanOf = ({ corners, weights }, values, width, i) => corners.reduce((sum, v, c) => sum + weights[c] * values[v * width + i], 0);
  // Where a ray meets the shown surface first: { hit, corners, weights } of a triangle, or nothing.
  const firstHit = () => {
    geometry.boundsTree ??= new Kit.MeshBVH(geometry, { indirect: true });
    raycaster.firstHitOnly = hidden.size === 0;
    for (const hit of raycaster.intersectObject(object)) {
      const corners = [hit.face.a, hit.face.b, hit.face.c];
      const triangle = corners.map((v) => new Kit.Vector3().fromArray(positions, 3 * v));
      const weights = Kit.Triangle.getBarycoord(hit.point, ...triangle, new Kit.Vector3())?.toArray();
      if (weights && corners.reduce((sum, v, c) => sum + weights[c] * shownOf.array[v], 0) >= 0.5) return { hit, corners, weights };
    }
    return null;
  };
  const pick = (x, y) => {
    raycaster.setFromCamera(new Kit.Vector2((2 * x) / innerWidth - 1, 1 - (2 * y) / innerHeight), camera);
    const found = firstHit();
    if (!found) return null;
    const { hit, corners, weights } = found;
    const mean = (values, width, i) => meanOf(found, values, width, i);
    const from = camera.position.clone().sub(hit.point).normalize().toArray();
    const mixture = names.map((_, k) => mean(abundances, K, k));
    // A half width of 0 is one that is not determined.
    const ends = mixture.map((share, k) => {
      if (!halfWidths || corners.some((v) => !halfWidths[v * K + k])) return null;
      const half = mean(halfWidths, K, k);
      return [Math.max(share - half, 0), Math.min(share + half, 1)];
    });
    return {
      place: hit.point.clone(), corners, weights, spectrum: spectrumOf(corners, weights, from), mixture, ends,
      finish: relit && [...[0, 1, 2].map((c) => mean(base, 3, c)), mean(polish, 3, 0), mean(polish, 3, 1)],
    };
  };

  // ---- regions ------------------------------------------------------------------------------------------------------
  const isInside = (outline, x, y) => {
    let inside = false;
    outline.forEach(([x1, y1], i) => {
      const [x2, y2] = outline.at(i - 1);
      if (y1 > y !== y2 > y && x < x1 + ((y - y1) / (y2 - y1)) * (x2 - x1)) inside = !inside;
    });
    return inside;
  };
  // Of vertices: those that light needs, or those of the triangles around.
  let across = normals;
  const normalsOf = () => {
    if (across) return across;
    const bare = new Kit.BufferGeometry().setAttribute("position", geometry.getAttribute("position")).setIndex(geometry.index);
    bare.computeVertexNormals();
    return (across = bare.getAttribute("normal").array);
  };
  const onScreen = new Kit.Vector3();
  // Column and row of a place, or nothing where no picture has it: behind the eye, or too near to it.
  const pixelOf = (place) => {
    const { x, y, z } = onScreen.copy(place).project(camera);
    return Math.abs(z) > 1 ? null : [((x + 1) / 2) * innerWidth, ((1 - y) / 2) * innerHeight];
  };
  const atVertex = (v) => ({ place: new Kit.Vector3().fromArray(positions, 3 * v), corners: [v], weights: [1] });
  // Is a point of the surface seen from here? What a ray meets before it is the point itself where it is nearer to it
  // than a triangle is long, there or here, and both show the same side: backs of thin parts don't.
  const isSeen = (point) => {
    const { origin, direction } = raycaster.ray;
    origin.copy(camera.position);
    direction.copy(point.place).sub(origin);
    const distance = direction.length();
    direction.normalize();
    const found = firstHit();
    if (!found || found.hit.distance > (1 - 1e-6) * distance) return true;
    const edge = Math.sqrt(Math.min(meanOf(point, areas, 1, 0), meanOf(found, areas, 1, 0)));
    if (found.hit.distance < distance - edge) return false;
    const facing = (one) => direction.toArray().reduce((sum, part, axis) => sum + part * meanOf(one, normalsOf(), 3, axis), 0);
    return facing(point) * facing(found) > 0;
  };
  // Which vertices are seen from here within an outline on the screen, 255 each, as regions of the run have them.
  const sharesInside = (outline) => {
    const shares = new Uint8Array(V);
    const [columns, rows] = [0, 1].map((axis) => outline.map((corner) => corner[axis]));
    const [left, right, top, bottom] = [Math.min(...columns), Math.max(...columns), Math.min(...rows), Math.max(...rows)];
    for (let v = 0; v < V; v++) {
      if (shownOf.array[v] < 0.5) continue;
      const vertex = atVertex(v);
      const [x, y] = pixelOf(vertex.place) ?? [NaN, NaN];
      if (!(x >= left && x <= right && y >= top && y <= bottom) || !isInside(outline, x, y)) continue;
      if (isSeen(vertex)) shares[v] = 255;
    }
    return shares;
  };
  // What a region is, weighted by area; its spectrum is without gloss. Nothing where no surface is in it.
  const measureRegion = (shares) => {
    const weights = areas.map((area, v) => (area * shares[v]) / 255);
    const area = weights.reduce((sum, weight) => sum + weight, 0);
    if (!(area > 0)) return null;
    const mean = (values, width, i) => weights.reduce((sum, weight, v) => sum + weight * values[v * width + i], 0) / area;
    const middle = [0, 1, 2].map((axis) => mean(positions, 3, axis));
    // Where its name may stand: first near the middle, then anywhere, since parts of it may be hidden.
    const inside = Array.from(shares.keys()).filter((v) => shares[v] > 0);
    const fromMiddle = (v) => Math.hypot(...middle.map((value, axis) => positions[3 * v + axis] - value));
    const nearest = inside.reduce((best, v) => (fromMiddle(v) < fromMiddle(best) ? v : best));
    const anywhere = Array.from({ length: 15 }, (_, i) => inside[Math.floor(((i + 0.5) / 15) * inside.length)]);
    const { mean: spectrum, spread } = B ? Spectra.mixtureStatistics(weights, scaled, facts.endmembers) : { mean: [], spread: null };
    return {
      shares, area, spectrum, spread, anchors: [nearest, ...anywhere].map(atVertex),
      mixture: names.map((_, k) => mean(abundances, K, k)),
      finish: relit && [...[0, 1, 2].map((c) => mean(base, 3, c)), mean(polish, 3, 0), mean(polish, 3, 1)],
    };
  };
  const paintRegions = () => {
    markOf.array.fill(0);
    probes.filter((probe) => probe.isShown && probe.shares).forEach(({ shares, colour }) => {
      const { r, g, b } = new Kit.Color().setStyle(colour, ""); // as it is on the screen
      for (let v = 0; v < V; v++) {
        const share = shares[v] / 255;
        if (share > 0) markOf.array.set([r * share, g * share, b * share, share], 4 * v);
      }
    });
    markOf.needsUpdate = true;
  };
  // Names beside the points, regions and notes that are seen from here, each in the nearest row that is free.
  const placeLabels = () => {
    const labels = $("labels");
    const noted = notes.map((note) => ({ name: nameOf(note), colour: NOTE, place: note.place }));
    const shown = [...probes.filter((probe) => probe.isShown), ...noted];
    const taken = [];
    while (labels.children.length < shown.length) labels.append(make("span"));
    [...labels.children].forEach((label, i) => {
      const { name, colour, place, anchors = [shown[i]] } = shown[i] ?? { anchors: [] };
      const anchor = anchors.find((one) => pixelOf(one.place) && isSeen(one));
      label.hidden = !anchor;
      label.className = "";
      if (!anchor) return;
      label.textContent = name;
      const [x, y] = pixelOf(anchor.place);
      const [width, height] = [label.offsetWidth + 2, label.offsetHeight + 2];
      const rows = [...(place ? [] : [0]), ...Array.from({ length: 16 }, (_, step) => (step % 2 ? 1 : -1) * (1 + (step >> 1)))];
      const isFree = (row) => taken.every((one) => 2 * Math.abs(one.x - x) >= one.width + width || Math.abs(one.y - y - row * height) >= height);
      const row = rows.find(isFree) ?? rows[0];
      taken.push({ x, y: y + row * height, width });
      Object.assign(label.style, { left: `${x}px`, top: `${y + row * height}px`, borderColor: colour });
      label.className = "placed";
    });
  };

  // ---- probes: points and regions, each with a spectrum -------------------------------------------------------------
  const probes = [];
  const COLOURS = ["#e6550d", "#3182bd", "#31a354", "#756bb1", "#d62790", "#8c6d31", "#17a2b8", "#777777"];
  const counts = { point: 0, region: 0 };
  let chosen = null; // the probe whose nearest known spectra are shown
  const freeColour = () => {
    const uses = COLOURS.map((colour) => probes.filter((probe) => probe.colour === colour).length);
    return COLOURS[uses.indexOf(Math.min(...uses))];
  };
  const addProbe = (kind, found, fields = {}) => {
    const points = probes.filter((probe) => !probe.shares);
    if (kind === "point" && points.length === COLOURS.length) removeProbe(points[0]);
    const name = fields.name ?? `${kind} ${++counts[kind]}`;
    chosen = { ...found, name, colour: freeColour(), isShown: true, likeness: B ? likeness(found.spectrum) : [], ...fields };
    probes.push(chosen);
  };
  const removeProbe = (probe) => {
    probes.splice(probes.indexOf(probe), 1);
    if (chosen === probe) chosen = probes.at(-1) ?? null;
  };
  const world = (place) => place.toArray().map((value, axis) => value + offset[axis]);
  const rulerEnds = [];
  const markAt = (place, colour) => {
    const dot = new Kit.Mesh(new Kit.SphereGeometry(sphere.radius / 90, 16, 12), new Kit.MeshBasicMaterial({ color: colour }));
    dot.position.copy(place);
    return dot;
  };
  const showMarks = () => {
    marks.clear();
    probes.filter((probe) => probe.isShown && probe.place).forEach((probe) => marks.add(markAt(probe.place, probe.colour)));
    notes.forEach((note) => marks.add(markAt(note.place, NOTE)));
    rulerEnds.forEach((place) => marks.add(markAt(place, "#ffb000")));
    if (rulerEnds.length === 2)
      marks.add(new Kit.Line(new Kit.BufferGeometry().setFromPoints(rulerEnds), new Kit.LineBasicMaterial({ color: "#ffb000", depthTest: false })));
    paintRegions();
    redraw();
  };
  const showProbes = () => { listProbes(); showMarks(); };
  const describe = (probe) => {
    const largest = probe.mixture.map((share, k) => [share, k]).filter(([share]) => share >= 0.02).sort((a, b) => b[0] - a[0]);
    const reach = (k) => (probe.ends?.[k] ? ` (${probe.ends[k].map((end) => Math.round(100 * end)).join(" to ")})` : "");
    const shares = largest.slice(0, 4).map(([share, k]) => `${names[k]} ${Math.round(100 * share)} %${reach(k)}`).join(", ");
    const isUnknown = facts.interval && probe.ends && largest.slice(0, 4).some(([, k]) => !probe.ends[k]);
    const [low, high] = probe.areaEnds ?? [];
    const [red, green, blue, roughness, metallicity] = probe.finish || [];
    return [
      probe.shares && areaText(probe.area) + (probe.areaEnds ? ` (${areaText(low)} to ${areaText(high)})` : ""), B && (shares || "nothing"),
      isUnknown && `interval not determined: ${facts.interval.not_determined || "too few views, or an endmember that is not"}`,
      probe.finish && `base colour ${hex([red, green, blue].map(toDisplay))}, roughness ${roughness.toFixed(2)}, metallicity ${metallicity.toFixed(2)}`,
      probe.place && `at ${world(probe.place).map(shownNumber).join(", ")}`,
    ].filter(Boolean).join("; ");
  };
  const probeRow = (probe) => {
    const shown = make("input", { type: "checkbox", checked: probe.isShown, title: "show or hide" });
    shown.onchange = () => { probe.isShown = shown.checked; showProbes(); };
    const dot = make("span", { className: "dot" });
    dot.style.background = probe.colour;
    const name = make("input", { type: "text", value: probe.name, maxLength: 64, title: probe.isKept ? "a region of the run" : "rename", readOnly: probe.isKept });
    // The click that ends this may be one into another name: nothing of the list is made anew.
    name.onchange = () => { probe.name = name.value = name.value.trim() || probe.name; redraw(); };
    name.onkeydown = (event) => { if (event.key === "Enter") name.blur(); };
    name.onfocus = () => { if (chosen !== probe) { chosen = probe; listProbes(probe); } };
    const remove = make("button", { textContent: "×", title: "remove", hidden: Boolean(probe.isKept), onclick: () => { removeProbe(probe); showProbes(); } });
    const feature = probe.isShown && absorptionOf(probe);
    const lines = [
      describe(probe),
      ...(feature ? [`absorption: depth ${shownNumber(feature.depth)}, centre ${shownNumber(feature.centre)} nm, area ${shownNumber(feature.area)} nm`] : []),
    ];
    const notes = lines.map((text) => make("p", { className: "note", textContent: text }));
    if (probe === chosen)
      probe.likeness.forEach((match, rank) => {
        const sample = svgElement("svg", { viewBox: "0 0 22 10", class: "sample" });
        sample.append(svgElement("line", { x1: 0, x2: 22, y1: 5, y2: 5, stroke: probe.colour, ...knownStyle(rank) }));
        notes.push(make("p", { className: "note" }, sample, ` like ${match.text}`));
      });
    return make("div", { className: probe === chosen ? "probe chosen" : "probe" }, shown, dot, name, remove, ...notes);
  };
  const listProbes = (focused) => {
    $("how").hidden = probes.length > 0;
    $("curves").hidden = !(B && probes.some((probe) => probe.isShown));
    $("chart").replaceChildren(...($("curves").hidden ? [] : [chart(curves())]));
    const newestFirst = [...probes].reverse();
    $("probes").replaceChildren(...newestFirst.map(probeRow));
    if (focused) $("probes").children[newestFirst.indexOf(focused)].querySelector("input[type='text']").focus();
  };

  // ---- curves -------------------------------------------------------------------------------------------------------
  // The bands of the window that is looked at, in which there is light.
  const windowBands = () => {
    const [low, high] = isRemoved() ? [$("low"), $("high")].map((input) => Number(input.value)) : [-Infinity, Infinity];
    return facts.wavelengths_nm.map((_, b) => b).filter((b) => facts.wavelengths_nm[b] >= low && facts.wavelengths_nm[b] <= high && isLit[b]);
  };
  const isRemoved = () => $("curve").value === "continuum removed";
  // Whether there are bands all over the window: without them nobody knows what absorbs there.
  const isCovered = (bands) => facts.ranges_nm.some(([low, high]) => bands.every((b) => low <= facts.wavelengths_nm[b] && facts.wavelengths_nm[b] <= high));
  const absorptionOf = (probe) => {
    const bands = windowBands();
    if (!isRemoved() || bands.length < 3 || !isCovered(bands)) return null;
    const reflectance = reflectanceOf(probe.spectrum);
    return Spectra.absorption(bands.map((b) => reflectance[b]), bands.map((b) => facts.wavelengths_nm[b]));
  };
  // What the chart shows: each shown probe, and the known spectra nearest to the chosen one, as bright as it.
  const curves = () => {
    const bands = windowBands();
    const nm = bands.map((b) => facts.wavelengths_nm[b]);
    const shown = probes.filter((probe) => probe.isShown);
    const found = shown.map((probe) => ({
      values: reflectanceOf(probe.spectrum), spread: !isRemoved() && probe.spread && reflectanceOf(probe.spread), colour: probe.colour,
    }));
    if (chosen?.isShown)
      chosen.likeness.forEach(({ reflectance }, rank) => {
        const factor = Spectra.brightness(reflectanceOf(chosen.spectrum), reflectance);
        found.push({ values: reflectance.map((value) => value * factor), colour: chosen.colour, style: knownStyle(rank) });
      });
    const inWindow = (values) => bands.map((b) => values[b]);
    // A known spectrum may lack bands: the continuum of those that it has.
    const removed = (values) => {
      const there = values.map((value, i) => i).filter((i) => Number.isFinite(values[i]));
      const ratios = Spectra.continuumRemoved(there.map((i) => values[i]), there.map((i) => nm[i]));
      return values.map((_, i) => (there.includes(i) ? ratios[there.indexOf(i)] : NaN));
    };
    const what = facts.is_light_known ? "reflectance" : "radiance";
    return {
      nm, quantity: isRemoved() ? `${what} over its continuum` : facts.is_light_known ? what : `${what}, 1 = full scale`,
      lines: found.map((curve) => ({
        ...curve, values: isRemoved() ? removed(inWindow(curve.values)) : inWindow(curve.values), spread: curve.spread && inWindow(curve.spread),
      })),
    };
  };
  const svgElement = (tag, fields, text = "") => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    Object.entries(fields).forEach(([name, value]) => element.setAttribute(name, value));
    element.textContent = text;
    return element;
  };
  const knownStyle = (rank) => ({ "stroke-width": 1.4, "stroke-dasharray": ["7 2", "3 3", "1 3"][rank] });
  const chart = ({ nm, quantity, lines }) => {
    const [left, right, top, bottom] = [34, 300, 8, 140];
    const upper = lines.flatMap(({ values, spread }) => values.map((value, i) => value + (spread ? spread[i] : 0))).filter(Number.isFinite);
    const lower = lines.flatMap(({ values }) => values).filter(Number.isFinite);
    const least = isRemoved() ? Math.min(1, ...lower) : 0;
    const most = Math.max(isRemoved() ? 1 : 1e-6, ...upper);
    const range = Math.max(most - least, 1e-9);
    const x = (value) => left + ((value - nm[0]) / Math.max(nm.at(-1) - nm[0], 1e-9)) * (right - left);
    const y = (value) => bottom - ((value - least) / range) * (bottom - top);
    const svg = svgElement("svg", { viewBox: "0 0 306 172" });
    const draw = (...content) => svg.append(svgElement(...content));
    draw("path", { d: `M${left} ${top}V${bottom}H${right}`, fill: "none", stroke: "currentColor", "stroke-opacity": 0.4 });
    const ends = [0, 0.5, 1];
    ends.forEach((part) => draw("text", { x: left - 4, y: y(least + part * range) + 3, "text-anchor": "end" }, (least + part * range).toPrecision(2)));
    if (nm.length < 2) {
      draw("text", { x: (left + right) / 2, y: (top + bottom) / 2, "text-anchor": "middle" }, "fewer than two bands to show");
      return svg;
    }
    ends.forEach((part) => {
      const value = nm[0] + part * (nm.at(-1) - nm[0]);
      draw("text", { x: x(value), y: bottom + 13, "text-anchor": part === 1 ? "end" : "middle" }, Math.round(value));
    });
    draw("text", { x: (left + right) / 2, y: bottom + 27, "text-anchor": "middle" }, `wavelength (nm); up: ${quantity}`);
    const at = (value, i) => (Number.isFinite(value) ? `${x(nm[i]).toFixed(1)},${y(value).toFixed(1)}` : "");
    // No line over a gap: what is between was not measured.
    const parts = facts.ranges_nm.map(([low, high]) => nm.map((_, i) => i).filter((i) => low <= nm[i] && nm[i] <= high));
    lines.forEach(({ values, spread, colour, style = { "stroke-width": 1.8 } }) => {
      for (const part of parts.filter((one) => one.length)) {
        if (spread) {
          const above = part.map((i) => at(values[i] + spread[i], i));
          const below = part.map((i) => at(Math.max(values[i] - spread[i], 0), i)).reverse();
          draw("polygon", { points: [...above, ...below].join(" "), fill: colour, "fill-opacity": 0.2 });
        }
        // A band between two gaps is a dot.
        const dot = part.length === 1 && { "stroke-linecap": "round", "stroke-width": 4, "stroke-dasharray": "none" };
        const points = [...part, part.at(-1)].map((i) => at(values[i], i)).join(" ");
        draw("polyline", { points, fill: "none", stroke: colour, ...style, ...dot });
      }
    });
    return svg;
  };
  const save = (name, blob) => {
    const link = make("a", { href: URL.createObjectURL(blob), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  const quoted = (text) => `"${text.replace(/^[=+@-]/, "_$&").replaceAll('"', '""')}"`; // no formula in a spreadsheet
  const csvText = () => {
    const shown = probes.filter((probe) => probe.isShown);
    const rows = [["quantity", ...shown.map((probe) => quoted(probe.name))]];
    // What no probe has gets no row.
    const add = (what, valueOf) => {
      const values = shown.map((probe) => valueOf(probe) ?? "");
      if (values.some((value) => value !== "")) rows.push([quoted(what), ...values]);
    };
    ["x", "y", "z"].forEach((axis, i) => add(axis, (probe) => probe.place && world(probe.place)[i]));
    add("area in square units", (probe) => probe.area);
    if (metresPerUnit !== null) add("area in cm2", (probe) => probe.area && probe.area * 1e4 * metresPerUnit ** 2);
    ["low", "high"].forEach((end, i) => add(`area in square units_${end}`, (probe) => probe.areaEnds?.[i]));
    names.forEach((name, k) => {
      add(`abundance of ${name}`, (probe) => probe.mixture[k]);
      ["low", "high"].forEach((end, i) => add(`abundance of ${name}_${end}`, (probe) => probe.ends?.[k]?.[i]));
    });
    ["base colour red", "base colour green", "base colour blue", "roughness", "metallicity"].forEach((what, i) =>
      add(what, (probe) => probe.finish?.[i]));
    const bands = windowBands();
    if (isRemoved() && bands.length >= 3 && isCovered(bands)) {
      const of = `of the absorption from ${facts.wavelengths_nm[bands[0]]} to ${facts.wavelengths_nm[bands.at(-1)]} nm`;
      ["depth", "centre", "area"].forEach((what) => add(`${what} ${of}`, (probe) => absorptionOf(probe)[what]));
    }
    [0, 1, 2].forEach((rank) => {
      add(`known spectrum ${rank + 1}`, ({ likeness }) => likeness[rank] && quoted(likeness[rank].name));
      add(`angle to known spectrum ${rank + 1} (rad)`, ({ likeness }) => likeness[rank]?.angle);
    });
    const what = facts.is_light_known ? "reflectance" : "radiance";
    facts.wavelengths_nm.forEach((nm, b) => add(`${what} at ${nm} nm`, (probe) => reflectanceOf(probe.spectrum)[b]));
    facts.wavelengths_nm.forEach((nm, b) =>
      add(`standard deviation at ${nm} nm`, (probe) => probe.spread && reflectanceOf(probe.spread)[b]));
    return rows.map((row) => row.join(",")).join("\r\n") + "\r\n";
  };
  $("csv").onclick = () => save("spectra.csv", new Blob([csvText()], { type: "text/csv" }));
  $("clear").onclick = () => {
    probes.filter((probe) => !probe.isKept).forEach(removeProbe);
    rulerEnds.length = 0;
    showLength();
    showProbes();
  };
  $("curve").onchange = () => { $("window").hidden = !isRemoved(); listProbes(); };
  $("low").onchange = $("high").onchange = () => listProbes();

  // ---- notes: what readers write at places, kept in the copies that they save ----------------------------------------
  const notes = []; // { text, place, from, picture }: `from` is where the eye was, `picture` a URL that holds it, or null
  const NOTE = "#0b5cad";
  const MOST_PX = 1024; // sides of a picture
  let isUnsaved = false;
  const nameOf = (note) => `${notes.indexOf(note) + 1} ${note.text.trim().split("\n")[0]}`;
  const noteToStore = ({ text, place, from, picture }) => ({ text, place: world(place), from: world(from), picture });
  // What a file says is a note, or nothing: it may have been written by hand.
  const noteFrom = ({ text, place, from, picture } = {}) => {
    const isPlace = (values) => Array.isArray(values) && values.length === 3 && values.every(Number.isFinite);
    const isPicture = picture === null || /^data:image\/jpeg;base64,[A-Za-z0-9+/]+=*$/.test(picture);
    if (typeof text !== "string" || !isPlace(place) || !isPlace(from) || !isPicture) return null;
    const [at, eye] = [place, from].map((values) => new Kit.Vector3(...values.map((value, axis) => value - offset[axis])));
    return { text, place: at, from: eye, picture };
  };
  const openNotes = () => {
    let stored = null;
    try { stored = JSON.parse($("data-notes").textContent); } catch { /* said below */ }
    const found = (Array.isArray(stored) ? stored : [null]).map((one) => noteFrom(one ?? {}));
    notes.push(...found.filter(Boolean));
    const damaged = found.length - notes.length;
    if (damaged) $("noted").textContent = `${damaged} of the notes in this file can't be read; a copy will lack ${damaged === 1 ? "it" : "them"}.`;
    if (found.length) $("notes").closest("details").open = true;
    listNotes();
  };
  const changeNotes = () => { isUnsaved = true; $("noted").textContent = "Not saved yet: save a copy of the page."; redraw(); };
  const addNote = (place) => {
    notes.push({ text: "", place, from: camera.position.clone(), picture: null });
    setMode(null);
    changeNotes();
    listNotes();
    if ($("panel").classList.contains("folded")) fold();
    $("notes").closest("details").open = true;
    $("notes").lastElementChild.querySelector("textarea").focus();
  };
  // A picture of any size as JPEG, on white, without what cameras write beside it.
  const readPicture = async (file) => {
    const image = await createImageBitmap(file);
    const smaller = Math.min(1, MOST_PX / Math.max(image.width, image.height));
    const [width, height] = [image.width, image.height].map((side) => Math.max(1, Math.round(smaller * side)));
    const drawn = make("canvas", { width, height });
    const brush = drawn.getContext("2d");
    brush.fillStyle = "#fff";
    brush.fillRect(0, 0, width, height);
    brush.drawImage(image, 0, 0, width, height);
    return drawn.toDataURL("image/jpeg", 0.85);
  };
  const noteRow = (note, i) => {
    const look = make("button", { textContent: i + 1, title: "look at the place", onclick: () => lookFrom(note.from, note.place) });
    const file = make("input", { type: "file", accept: "image/*", hidden: true });
    file.onchange = async () => {
      try {
        note.picture = await readPicture(file.files[0]);
      } catch {
        $("noted").textContent = `${file.files[0].name} is no picture that this browser reads: choose a JPEG or PNG.`;
        return;
      }
      changeNotes();
      listNotes();
    };
    const picture = note.picture
      ? make("button", { textContent: "Remove picture", onclick: () => { note.picture = null; changeNotes(); listNotes(); } })
      : make("button", { textContent: "Picture", title: "add a picture", onclick: () => file.click() });
    const remove = make("button", { textContent: "×", title: "remove the note", onclick: () => { notes.splice(notes.indexOf(note), 1); changeNotes(); listNotes(); } });
    const text = make("textarea", { value: note.text, maxLength: 4000 });
    text.setAttribute("aria-label", `note ${i + 1}`);
    text.oninput = () => { note.text = text.value; changeNotes(); };
    const shown = note.picture ? [make("img", { src: note.picture, alt: `picture of note ${i + 1}` })] : [];
    return make("div", { className: "probe" }, look, picture, file, make("span"), remove, text, ...shown);
  };
  const listNotes = () => { $("notes").replaceChildren(...notes.map(noteRow)); showMarks(); };
  const copyOfPage = () => {
    const inScript = (value) => JSON.stringify(value).replaceAll("<", "\\u003c"); // no text ends its element
    untouched.querySelector("#data-notes").textContent = inScript(notes.map(noteToStore));
    untouched.querySelector("#data-arrays").textContent = packed;
    return `<!DOCTYPE html>\n${untouched.outerHTML}`;
  };
  $("copy").onclick = () => {
    save("page-with-notes.html", new Blob([copyOfPage()], { type: "text/html" }));
    isUnsaved = false;
    $("noted").textContent = "";
  };
  addEventListener("beforeunload", (event) => { if (isUnsaved) event.preventDefault(); });

  // ---- lengths ------------------------------------------------------------------------------------------------------
  const lengthText = (length) => {
    if (metresPerUnit === null) return `${shownNumber(length)} world ${length === 1 ? "unit" : "units"}`;
    const metres = length * metresPerUnit;
    const [factor, unit] = metres >= 1 ? [1, "m"] : metres >= 0.01 ? [100, "cm"] : [1000, "mm"];
    return `${shownNumber(metres * factor)} ${unit}`;
  };
  const areaText = (area) => {
    if (metresPerUnit === null) return `${shownNumber(area)} square units`;
    const square = area * metresPerUnit ** 2;
    return square >= 1 ? `${shownNumber(square)} m²` : `${shownNumber(1e4 * square)} cm²`;
  };
  const showLength = () => {
    const isWhole = rulerEnds.length === 2;
    $("known").hidden = !isWhole;
    $("length").textContent = isWhole ? lengthText(rulerEnds[0].distanceTo(rulerEnds[1])) : mode === "ruler" ? "click two points" : "";
  };
  // What a click or a stroke is for: a spectrum (no mode), the ruler, or a region.
  let mode = null;
  const HINTS = { ruler: "Click two points of the object.", region: "Draw around a part of the object.", note: "Click the place that the note is about." };
  const setMode = (name) => {
    mode = name;
    $("hint").textContent = HINTS[mode] ?? "";
    Object.keys(HINTS).forEach((one) => $(one).setAttribute("aria-pressed", mode === one));
    controls.enabled = mode !== "region";
    if (mode === "ruler") rulerEnds.length = 0;
    if (mode && innerWidth <= 700 && !$("panel").classList.contains("folded")) fold();
    showLength();
    showMarks();
  };
  Object.keys(HINTS).forEach((name) => { $(name).onclick = () => setMode(mode === name ? null : name); });
  $("true-length").onchange = () => {
    const metres = Number($("true-length").value);
    const length = rulerEnds.length === 2 ? rulerEnds[0].distanceTo(rulerEnds[1]) : 0;
    if (!(metres > 0) || !(length > 0)) { $("length").textContent = "a length must be greater than 0"; return; }
    metresPerUnit = metres / length;
    showLength();
    listProbes();
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
    $("scale").textContent = lengthText(length / unit);
  };

  // ---- hands and keys -----------------------------------------------------------------------------------------------
  let pressed = null;
  let outline = null; // of a region that is being drawn: columns and rows
  const drawOutline = () => $("outline").setAttribute("points", (outline ?? []).map((corner) => corner.join(",")).join(" "));
  // A second finger begins a pinch, which picks nothing.
  canvas.addEventListener("pointerdown", (event) => {
    pressed = event.isPrimary ? [event.clientX, event.clientY] : null;
    if (mode !== "region" || event.button) return;
    outline = pressed && [pressed];
    canvas.setPointerCapture(event.pointerId);
    drawOutline();
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = outline?.at(-1);
    if (!last || !event.isPrimary || Math.hypot(event.clientX - last[0], event.clientY - last[1]) < 3) return;
    outline.push([event.clientX, event.clientY]);
    drawOutline();
  });
  canvas.addEventListener("pointercancel", () => { outline = null; drawOutline(); });
  canvas.addEventListener("pointerup", (event) => {
    const [from, drawn] = [pressed, outline];
    [pressed, outline] = [null, null];
    drawOutline();
    if (drawn) { addRegion(drawn); return; }
    if (!from || Math.hypot(event.clientX - from[0], event.clientY - from[1]) > 5 || event.button) return;
    const found = pick(event.clientX, event.clientY);
    if (!found) return;
    if (mode === "ruler") {
      if (rulerEnds.length === 2) rulerEnds.length = 0;
      rulerEnds.push(found.place);
      showLength();
      showMarks();
    } else if (mode === "note") {
      addNote(found.place);
    } else {
      addProbe("point", found);
      showProbes();
      openAt($("curves").hidden ? $("probes") : $("curves"));
    }
  });
  const addRegion = (drawn) => {
    const found = drawn.length > 2 && measureRegion(sharesInside(drawn));
    if (!found) {
      $("hint").textContent = "Nothing of the surface is inside: draw around a part of the object.";
      return;
    }
    addProbe("region", found);
    setMode(null);
    listProbes();
    openAt($("curves").hidden ? $("probes") : $("curves"));
  };
  // Unfold the panel; where it is small, with an element in sight.
  const openAt = (element) => {
    if ($("panel").classList.contains("folded")) fold();
    if (innerWidth <= 700) element.scrollIntoView();
  };
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
  const keys = {
    0: wholeObject, t: theme, p: fold, r: () => $("ruler").click(), d: () => $("region").click(), n: () => $("note").click(), "[": () => step(-1), "]": () => step(1),
    Escape: () => (mode ? setMode(null) : $("clear").click()),
  };
  layers.forEach(([layer], index) => (keys[index + 1] = () => choose(layer)));
  addEventListener("keydown", (event) => {
    const isAlt = (event.ctrlKey || event.metaKey || event.altKey) && !event.getModifierState("AltGraph");
    if (isAlt || event.target.matches("select, textarea, input[type='text'], input[type='number']")) return;
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
      facts.is_light_known ? "spectra of points are reflectance" : "the light is unknown: spectra are radiance, 1 = full scale",
    ] : []),
    ...(facts.scale ? [`scale: ${facts.scale}`] : []), ...facts.notes, facts.made, "Keys: 1 to 7 layers, [ and ] bands, 0 whole object, D draw a region, R ruler, N note, T light or dark, P panel, Esc clears; arrows move, with shift they turn.",
  ];
  $("facts").replaceChildren(...about.map((text) => make("p", { className: "note", textContent: text })));
  document.querySelector("#head h1").textContent = facts.title;
  $("fallback").before(canvas);
  $("panel").hidden = false;
  if (innerWidth <= 700) fold();
  document.body.classList.add("ready");
  listMaterials();
  $("materials").parentElement.hidden = !K;
  if (!B) $("how").textContent = "Click the object, or draw around a part of it: its material appears here.";
  [$("low").value, $("high").value] = [Math.floor(facts.wavelengths_nm[0]), Math.ceil(facts.wavelengths_nm.at(-1))];
  facts.regions.forEach((name, r) => {
    const found = measureRegion(keptShares.subarray(r * V, (r + 1) * V));
    const { abundances: ends, area: areaEnds } = facts.interval?.regions[r] ?? {};
    if (found) addProbe("region", found, { name, isKept: true, isShown: r < COLOURS.length, ends, areaEnds });
  });
  openNotes();
  choose("colour");
  showProbes();
  wholeObject();
  frame();
  window.unmixPage = { state, choose, lookThrough, wholeObject, pick, fold, csvText, facts, draw, probes, notes, materialAreas: [...materialAreas] };
})();
