// optics/shade.py on a graphics chip: S0 of a dielectric under one unpolarized light.
// n, v, l: unit vectors to the outside, the eye and the light; diffuse rho_d and specular F0 linear;
// roughness perceptual, alpha = roughness^2. A white Lambertian plane that faces the light gives 1.
precision highp float;

float refracted(float c, float ior) { return sqrt(ior * ior - 1.0 + c * c); }

float transmitted(float c, float ior) {  // T+, the same in both directions
  float g = refracted(c, ior), n2 = ior * ior;
  float s = c + g, p = n2 * c + g;
  return 2.0 * c * g * (1.0 / (s * s) + n2 / (p * p));
}

float reflected(float c, float ior) {  // R+
  float g = refracted(c, ior), n2 = ior * ior;
  float s = (c - g) / (c + g), p = (n2 * c - g) / (n2 * c + g);
  return 0.5 * (s * s + p * p);
}

float distribution(float c, float alpha) {
  float a2 = alpha * alpha, d = (a2 - 1.0) * c * c + 1.0;
  return a2 / (3.14159265 * d * d);
}

float masking(float c, float alpha) {
  float a2 = alpha * alpha;
  return 2.0 * c / (c + sqrt(a2 + (1.0 - a2) * c * c));
}

vec3 shade(vec3 n, vec3 v, vec3 l, vec3 diffuse, vec3 specular, float roughness, float ior) {
  float out_ = dot(n, v), in_ = dot(n, l);
  if (out_ <= 0.0 || in_ <= 0.0) return vec3(0.0);
  float co = clamp(out_, 1e-4, 1.0), ci = clamp(in_, 1e-4, 1.0);
  vec3 h = normalize(l + v);
  float ch = clamp(dot(n, h), 1e-4, 1.0), cd = clamp(dot(v, h), 1e-4, 1.0);
  float alpha = roughness * roughness, f0 = (ior - 1.0) / (ior + 1.0);
  float body = ci * transmitted(ci, ior) * transmitted(co, ior);
  float facets = 3.14159265 * distribution(ch, alpha) * masking(ci, alpha) * masking(co, alpha)
    / (4.0 * co) / (f0 * f0) * reflected(cd, ior);
  return diffuse * body + specular * facets;
}

vec3 encoded(vec3 x) {  // sRGB
  x = clamp(x, 0.0, 1.0);
  return mix(1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, 12.92 * x, step(x, vec3(0.0031308)));
}
