// What is computed of spectra alone: their continuum and absorptions, their likeness to known ones, formulas of them.
//
// A spectrum is an array of a number a band; `nm` are the wavelengths of the bands, increasing. NaN is where nothing is
// known. All follow the definitions of unmix_plugin/spectral, which name their sources.
const Spectra = (() => {
  "use strict";

  // Upper convex hull of a spectrum over its wavelengths (Andrew 1979), as features.continuum has it.
  const continuum = (values, nm) => {
    if (!values.every(Number.isFinite)) return values.map(() => NaN);
    const corners = [];
    const bulges = (a, b, c) => (values[b] - values[a]) * (nm[c] - nm[a]) > (values[c] - values[a]) * (nm[b] - nm[a]);
    values.forEach((_, band) => {
      while (corners.length > 1 && !bulges(corners.at(-2), corners.at(-1), band)) corners.pop();
      corners.push(band);
    });
    let right = 0;
    return values.map((value, band) => {
      while (corners[right] < band) right++;
      if (corners[right] === band) return value;
      const [a, b] = [corners[right - 1], corners[right]];
      return values[a] + ((nm[band] - nm[a]) / (nm[b] - nm[a])) * (values[b] - values[a]);
    });
  };

  const continuumRemoved = (values, nm) => {
    const hull = continuum(values, nm);
    const beside = Math.max(...hull) > 0 ? 1 : NaN;
    return values.map((value, band) => (hull[band] > 0 ? value / hull[band] : beside));
  };

  const LEAST_DEPTH = 0.01; // of an absorption that has a centre
  // Depth, centre (nm) and area (nm) of the deepest absorption below the continuum of these bands, three or more.
  const absorption = (values, nm) => {
    const removed = continuumRemoved(values, nm);
    if (!removed.every(Number.isFinite)) return { depth: NaN, centre: NaN, area: NaN };
    let area = 0;
    for (let band = 1; band < nm.length; band++)
      area += ((2 - removed[band - 1] - removed[band]) / 2) * (nm[band] - nm[band - 1]);
    let lowest = 1;
    for (let band = 2; band < nm.length - 1; band++) if (removed[band] < removed[lowest]) lowest = band;
    const [before, least, after] = [-1, 0, 1].map((step) => removed[lowest + step]);
    const [back, ahead] = [nm[lowest - 1] - nm[lowest], nm[lowest + 1] - nm[lowest]];
    // Newton's form of the parabola: least + first * t + second * t * (t - back), t = wavelength - that of the lowest.
    const first = (before - least) / back;
    const second = ((after - least) / ahead - first) / (ahead - back);
    const offset = second > 0 ? (back - first / second) / 2 : 0;
    const depth = 1 - (least + first * offset + second * offset * (offset - back));
    return { depth, centre: depth >= LEAST_DEPTH ? nm[lowest] + offset : NaN, area };
  };

  // Angle in radians between two spectra over the bands that both have, NaN where one is black.
  const angle = (a, b) => {
    let [both, ofA, ofB] = [0, 0, 0];
    a.forEach((value, band) => {
      if (!Number.isFinite(value) || !Number.isFinite(b[band])) return;
      both += value * b[band];
      ofA += value * value;
      ofB += b[band] * b[band];
    });
    return Math.acos(Math.min(1, Math.max(-1, both / Math.sqrt(ofA * ofB))));
  };

  // The known spectra that resemble one most, nearest first: { index, angle }.
  const nearest = (spectrum, known, count) =>
    known
      .map((reflectance, index) => ({ index, angle: angle(spectrum, reflectance) }))
      .filter((match) => Number.isFinite(match.angle))
      .sort((a, b) => a.angle - b.angle)
      .slice(0, count);

  // What a known spectrum is multiplied with to be as bright as another (least squares).
  const brightness = (spectrum, known) => {
    let [both, own] = [0, 0];
    spectrum.forEach((value, band) => {
      if (!Number.isFinite(value) || !Number.isFinite(known[band])) return;
      both += value * known[band];
      own += known[band] * known[band];
    });
    return own > 0 ? both / own : 0;
  };

  // Mean and standard deviation over an area, whose parts have weights, of mixtures: parts' shares (K numbers each) of
  // spectra. The spread follows from the second moments of the shares, K * K numbers, whatever the number of bands.
  const mixtureStatistics = (weights, shares, spectra) => {
    const K = spectra.length;
    const [sums, products] = [new Float64Array(K), new Float64Array(K * K)];
    let total = 0;
    weights.forEach((weight, part) => {
      if (!(weight > 0)) return;
      total += weight;
      for (let k = 0; k < K; k++) {
        const own = weight * shares[part * K + k];
        if (own === 0) continue;
        sums[k] += own;
        for (let other = 0; other < K; other++) products[k * K + other] += own * shares[part * K + other];
      }
    });
    const bands = spectra[0].map((_, band) => band);
    const mean = bands.map((band) => spectra.reduce((sum, spectrum, k) => sum + (sums[k] / total) * spectrum[band], 0));
    const spread = bands.map((band) => {
      let square = 0;
      for (let k = 0; k < K; k++)
        for (let other = 0; other < K; other++)
          square += (products[k * K + other] / total) * spectra[k][band] * spectra[other][band];
      return Math.sqrt(Math.max(0, square - mean[band] ** 2));
    });
    return { mean, spread };
  };

  // A formula of reflectances: { value, bands }, the function that evaluates it and the bands that it looks at.
  // Numbers, r800, + - * / ^ **, parentheses, sqrt log exp abs min max; what is not finite is NaN.
  const parseFormula = (text, nm, ranges) => {
    const tokens = text.toLowerCase().match(/\d+\.?\d*(?:e[+-]?\d+)?|\.\d+|[a-z_][a-z0-9_.]*|\*\*|\S/g) || [];
    const used = new Set();
    let at = 0;
    const fail = (what) => {
      throw new Error(
        `${what}; allowed are numbers, r800 (the reflectance at 800 nm), + - * / ^, parentheses, sqrt log exp abs min max`,
      );
    };
    const expect = (sign) => tokens[at++] === sign || fail(`${sign} is missing`);
    const functions = new Map(
      Object.entries({
        sqrt: [Math.sqrt, 1], log: [Math.log, 1], exp: [Math.exp, 1], abs: [Math.abs, 1], min: [Math.min, 2], max: [Math.max, 2],
      }),
    );
    const finite = (value) => (Number.isFinite(value) ? value : NaN);
    const reflectanceAt = (wavelength) => {
      if (!ranges.some(([low, high]) => low <= wavelength && wavelength <= high)) throw new Error(`${wavelength} nm is outside the bands`);
      let right = nm.findIndex((centre) => centre >= wavelength);
      if (right < 0) right = nm.length - 1;
      const left = nm[right] <= wavelength || right === 0 ? right : right - 1;
      [left, right].forEach((band) => used.add(band));
      const part = left === right ? 0 : (wavelength - nm[left]) / (nm[right] - nm[left]);
      return (r) => r[left] + part * (r[right] - r[left]);
    };
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
      if (least === 1 ? values.length !== 1 : values.length < 2)
        fail(`${token} takes ${least === 1 ? "one value" : "two values or more"}`);
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
    const value = sum();
    if (at < tokens.length) fail(`${tokens[at]} is not expected there`);
    return { value, bands: used };
  };

  return { absorption, angle, brightness, continuumRemoved, mixtureStatistics, nearest, parseFormula };
})();
