'use strict';
// The pointer over one map shows the value of every map at that pixel of the object.
const DATA = JSON.parse(document.getElementById('data').textContent);

function bytes(text) { return Uint8Array.from(atob(text), (c) => c.charCodeAt(0)); }

// color -> level of each palette
const LEVELS = Object.fromEntries(Object.entries(DATA.palettes || {}).map(([name, text]) => {
  const rgb = bytes(text), level = new Map();
  for (let k = 0; 3 * k < rgb.length; k++) level.set((rgb[3 * k] << 16) | (rgb[3 * k + 1] << 8) | rgb[3 * k + 2], k);
  return [name, level];
}));

function linear(code) {
  const x = code / 255;
  return x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
}

function pixels(image) {  // RGBA of a decoded image element
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, canvas.width, canvas.height);
}

class Probe {
  constructor(figure) {
    this.figure = figure;
    this.about = JSON.parse(figure.dataset.map);
    this.image = figure.querySelector('img');
    this.output = figure.querySelector('output');
    this.cross = figure.querySelector('.cross');
    this.pixels = null;
    const box = this.image.parentElement;
    for (const kind of ['pointermove', 'pointerdown']) {
      box.addEventListener(kind, (event) => {
        const place = this.image.getBoundingClientRect();
        point((event.clientX - place.left) / place.width, (event.clientY - place.top) / place.height);
      });
    }
    box.addEventListener('pointerleave', () => point(-1, -1));
  }

  value(u, v) {  // text
    this.pixels ??= pixels(this.image);
    const { width, height, data } = this.pixels;
    const k = 4 * (Math.min(height - 1, Math.floor(v * height)) * width + Math.min(width - 1, Math.floor(u * width)));
    const [r, g, b, a] = data.subarray(k, k + 4), { kind, unit, digits } = this.about;
    if (a < 128) return '';
    if (r + g + b === 0 && kind !== 'scalar') return '';  // far outside the object
    if (kind === 'normal') return [r, g, b].map((x) => (x / 127.5 - 1).toFixed(2)).join(', ');
    if (kind === 'color') return [r, g, b].map((x) => (this.about.top * linear(x)).toFixed(digits)).join(', ');
    const { low, high, power, palette } = this.about;
    const level = LEVELS[palette].get((r << 16) | (g << 8) | b);
    if (level === undefined) return '';
    const share = palette === 'wheel' ? level / 255 : level / 254;
    return (low + (high - low) * share ** power).toFixed(digits) + unit;
  }

  show(u, v) {
    const inside = u >= 0 && u <= 1 && v >= 0 && v <= 1;
    this.output.textContent = inside ? this.value(u, v) : '';
    this.cross.style.display = inside ? 'block' : 'none';
    this.cross.style.left = `${100 * u}%`;
    this.cross.style.top = `${100 * v}%`;
  }
}

const PROBES = [...document.querySelectorAll('figure[data-map]')].map((figure) => new Probe(figure));
function point(u, v) { for (const probe of PROBES) probe.show(u, v); }
