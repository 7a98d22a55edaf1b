// Neural materials of a neumatex run: from diffuse colour and latents A and B to reflectance.
//
// GLSL ES 3.00 and GLSL 3.30. Textures: diffuse_colour, latents_a and latents_b; the PNG of the first is sRGB, decode it
// to linear, the others are linear, 0 to 1. Directions are unit vectors in the local frame of a point, z along its
// normal: wi to the light, wo to the eye. `reflectance` is in 1/sr, without the cosine, reciprocal, and reflects no more
// light than it gets.
//
// The latents have no meaning of their own, one by one. A small network, the same for all objects, decodes them to a
// stack of analytic layers: dust over sheen over clear coat over a glossy surface with haze over the diffuse base.

//@constants

const float PI = 3.14159265358979;
const float SMALLEST_ALPHA = 0.002;
const float SMALLEST_COSINE = 1e-4;
const float COAT_F0 = 0.04;

struct Stack {
  float dustCover;       // of light at normal incidence, 0 to 0.7
  vec3 sheenColour;
  float sheenRoughness;
  float coatWeight;
  vec3 roughness;        // perceptual: of the coat, of the surface, of its haze
  float hazeWeight;      // part of the surface's reflection that is spread, 0 to 0.7
  float metallicity;
  vec3 metalColour;
  float dielectricF0;    // 0 to 0.08
};

struct Passing { float dust; float sheen; float coat; float surface; };  // what layers let through along a direction

float sigmoid(float x) { return 1.0 / (1.0 + exp(-x)); }

float silu(float x) { return x * sigmoid(x); }

Stack decode(vec3 latentsA, vec3 latentsB) {
  float x[LATENTS] = float[LATENTS](latentsA.x, latentsA.y, latentsA.z, latentsB.x, latentsB.y, latentsB.z);
  float first[WIDTH];
  float second[WIDTH];
  float n[OUTPUTS];
  for (int i = 0; i < WIDTH; ++i) {
    float sum = BIAS_0[i];
    for (int j = 0; j < LATENTS; ++j) sum += WEIGHT_0[i * LATENTS + j] * (2.0 * x[j] - 1.0);
    first[i] = silu(sum);
  }
  for (int i = 0; i < WIDTH; ++i) {
    float sum = BIAS_1[i];
    for (int j = 0; j < WIDTH; ++j) sum += WEIGHT_1[i * WIDTH + j] * first[j];
    second[i] = silu(sum);
  }
  for (int i = 0; i < OUTPUTS; ++i) {
    float sum = BIAS_2[i];
    for (int j = 0; j < WIDTH; ++j) sum += WEIGHT_2[i * WIDTH + j] * second[j];
    n[i] = sigmoid(sum);
  }
  Stack s;
  s.dustCover = LARGEST_COVER * n[0];
  s.sheenColour = LARGEST_SHEEN * vec3(n[1], n[2], n[3]);
  s.sheenRoughness = n[4];
  s.coatWeight = n[5];
  s.roughness = vec3(LARGEST_COAT_ROUGHNESS * n[6], n[7], n[7] + (1.0 - n[7]) * n[8]);
  s.hazeWeight = LARGEST_HAZE * n[9];
  s.metallicity = n[10];
  s.metalColour = vec3(n[11], n[12], n[13]);
  s.dielectricF0 = LARGEST_DIELECTRIC_F0 * n[14];
  return s;
}

// Bilinear in tables with a row for each roughness from 0 to 1 and a column for each square root of the cosine.
vec4 corners(float roughness, float cosine, out ivec4 cells) {
  float row = roughness * float(ROWS - 1);
  float column = sqrt(clamp(cosine, 0.0, 1.0)) * float(COLUMNS - 1);
  float r = clamp(floor(row), 0.0, float(ROWS - 2));
  float c = clamp(floor(column), 0.0, float(COLUMNS - 2));
  int cell = int(r) * COLUMNS + int(c);
  cells = ivec4(cell, cell + 1, cell + COLUMNS, cell + COLUMNS + 1);
  float y = row - r;
  float x = column - c;
  return vec4((1.0 - y) * (1.0 - x), (1.0 - y) * x, y * (1.0 - x), y * x);
}

// A GGX lobe of Schlick's Fresnel term reflects f0 * x + y of what comes from this cosine.
vec2 ggxAlbedo(float roughness, float cosine) {
  ivec4 i;
  vec4 w = corners(roughness, cosine, i);
  return vec2(
    dot(w, vec4(GGX_A[i.x], GGX_A[i.y], GGX_A[i.z], GGX_A[i.w])),
    dot(w, vec4(GGX_B[i.x], GGX_B[i.y], GGX_B[i.z], GGX_B[i.w])));
}

vec2 meanGgxAlbedo(float roughness) {
  float row = roughness * float(ROWS - 1);
  float r = clamp(floor(row), 0.0, float(ROWS - 2));
  int i = int(r);
  return mix(vec2(GGX_MEAN_A[i], GGX_MEAN_B[i]), vec2(GGX_MEAN_A[i + 1], GGX_MEAN_B[i + 1]), row - r);
}

float sheenAlbedo(float roughness, float cosine) {
  ivec4 i;
  vec4 w = corners(roughness, cosine, i);
  return dot(w, vec4(SHEEN[i.x], SHEEN[i.y], SHEEN[i.z], SHEEN[i.w]));
}

float alphaOf(float roughness) { return SMALLEST_ALPHA + (1.0 - SMALLEST_ALPHA) * roughness * roughness; }

float schlick(float cosine) {
  float x = clamp(1.0 - cosine, 0.0, 1.0);
  return x * x * x * x * x;
}

// Density of GGX normals times Smith's height-correlated visibility.
float ggxLobe(float alpha, vec3 h, float ni, float no) {
  float a2 = alpha * alpha;
  float cosine = max(h.z, 0.0);
  float spread = max(a2 * cosine * cosine + h.x * h.x + h.y * h.y, 1e-9);
  ni = max(ni, SMALLEST_COSINE);
  no = max(no, SMALLEST_COSINE);
  float masks = ni * sqrt(no * no + a2 * (1.0 - no * no)) + no * sqrt(ni * ni + a2 * (1.0 - ni * ni));
  return cosine > 0.0 ? a2 / (PI * spread * spread) * 0.5 / masks : 0.0;
}

float sheenLobe(float roughness, vec3 h, float ni, float no) {
  float exponent = 1.0 / (SMALLEST_SHEEN_WIDTH + (1.0 - SMALLEST_SHEEN_WIDTH) * roughness);
  float sine = sqrt(max(h.x * h.x + h.y * h.y, 1e-12));
  ni = max(ni, SMALLEST_COSINE);
  no = max(no, SMALLEST_COSINE);
  return (2.0 + exponent) / (2.0 * PI) * pow(sine, exponent) / (4.0 * (ni + no - ni * no));
}

Passing passing(Stack s, float cosine) {
  cosine = max(cosine, 0.0);
  vec2 coat = ggxAlbedo(s.roughness.x, cosine);
  vec2 gloss = ggxAlbedo(s.roughness.y, cosine);
  vec2 haze = ggxAlbedo(s.roughness.z, cosine);
  float strongest = max(s.sheenColour.x, max(s.sheenColour.y, s.sheenColour.z));
  vec2 held = vec2(s.dielectricF0 * gloss.x + gloss.y, s.dielectricF0 * haze.x + haze.y);
  return Passing(
    exp(log(1.0 - s.dustCover) / max(cosine, SMALLEST_COSINE)),
    1.0 - strongest * sheenAlbedo(s.sheenRoughness, cosine),
    1.0 - s.coatWeight * (COAT_F0 * coat.x + coat.y),
    1.0 - mix(held.x, held.y, s.hazeWeight));
}

vec3 dustReflection(Stack s, float light, float eye) {
  float mean = 1.0;
  for (int i = 0; i < NODES; ++i)
    mean -= 2.0 * NODE_WEIGHTS[i] * NODE_PLACES[i] * exp(log(1.0 - s.dustCover) / NODE_PLACES[i]);
  return (1.0 - light) * (1.0 - eye) / max(mean, 1e-6) * DUST_COLOUR / PI;
}

vec3 reflectance(vec3 diffuseColour, vec3 latentsA, vec3 latentsB, vec3 wi, vec3 wo) {
  if (wi.z <= 0.0 || wo.z <= 0.0) return vec3(0.0);
  Stack s = decode(latentsA, latentsB);
  Passing light = passing(s, wi.z);
  Passing eye = passing(s, wo.z);
  float dust = light.dust * eye.dust;
  float sheen = dust * light.sheen * eye.sheen;
  float coat = sheen * light.coat * eye.coat;
  vec3 h = normalize(wi + wo);
  float edge = schlick(dot(wo, h));
  vec3 lobes = vec3(
    ggxLobe(alphaOf(s.roughness.x), h, wi.z, wo.z),
    ggxLobe(alphaOf(s.roughness.y), h, wi.z, wo.z),
    ggxLobe(alphaOf(s.roughness.z), h, wi.z, wo.z));
  vec3 f0 = mix(vec3(s.dielectricF0), s.metalColour, s.metallicity);
  vec2 gloss = meanGgxAlbedo(s.roughness.y);
  vec2 haze = meanGgxAlbedo(s.roughness.z);
  float surfaceMean =
    1.0 - mix(s.dielectricF0 * gloss.x + gloss.y, s.dielectricF0 * haze.x + haze.y, s.hazeWeight);
  float passed = coat * (1.0 - s.metallicity) * light.surface * eye.surface / surfaceMean;
  vec3 specular = coat * mix(lobes.y, lobes.z, s.hazeWeight) * mix(f0, vec3(1.0), edge)
    + sheen * s.coatWeight * mix(COAT_F0, 1.0, edge) * lobes.x
    + dust * sheenLobe(s.sheenRoughness, h, wi.z, wo.z) * s.sheenColour
    + dustReflection(s, light.dust, eye.dust);
  return passed * diffuseColour / PI + specular;
}
