// The parts of OpenLIME's interface that the page uses, drawn by Ward's law on a 2D canvas; see OpenLIME's LayerBRDF.
'use strict';
const decoded = (v) => (v > 0.04045 ? ((v + 0.055) / 1.055) ** 2.4 : v / 12.92);

function pixels(address) {
  return new Promise((resolve, reject) => {
    const image = new Image();
    image.onload = () => {
      const canvas = Object.assign(document.createElement('canvas'), { width: image.width, height: image.height });
      const context = canvas.getContext('2d');
      context.drawImage(image, 0, 0);
      resolve(context.getImageData(0, 0, image.width, image.height));
    };
    image.onerror = () => reject(new Error(`no picture ${address}`));
    image.src = address;
  });
}

class Layer {
  constructor(options) {
    if (options.type !== 'brdf' || options.layout !== 'image') throw new Error('another kind of layer');
    Object.assign(this, options, { light: [0, 0], drawn: () => {} });
    const names = Object.keys(options.channels);
    this.ready = Promise.all(names.map((name) => pixels(options.channels[name]))).then((found) => {
      this.maps = Object.fromEntries(names.map((name, k) => [name, found[k].data]));
      this.size = [found[0].width, found[0].height];
      if (found.some((one) => one.width !== this.size[0] || one.height !== this.size[1])) throw new Error('sizes');
    });
  }

  setLight(light) { this.light = light; this.drawn(); }

  draw(canvas) {
    const { kd, ks, normals, gloss } = this.maps, [low, high] = this.alphaLimits.map((a) => a ** 0.25);
    [canvas.width, canvas.height] = this.size;
    const context = canvas.getContext('2d'), out = context.createImageData(...this.size);
    const [x, y] = this.light, z = Math.sqrt(Math.max(1 - x * x - y * y, 0)), r = Math.hypot(x, y, z);
    const l = [x / r, y / r, z / r], h = [l[0], l[1], l[2] + 1], size = Math.hypot(...h);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    for (let k = 0; k < out.data.length; k += 4) {
      const n = [0, 1, 2].map((c) => normals[k + c] / 127.5 - 1), length = Math.hypot(...n);
      if (length < 0.5) continue;
      const nl = dot(n, l) / length, nv = n[2] / length, nh = dot(n, h) / size / length;
      const slope = (high + (gloss[k] / 255) * (low - high)) ** 4;
      const lobe = nl * nv > 0 && slope > 0.004
        ? Math.exp(-((Math.tan(Math.acos(Math.min(nh, 1))) / slope) ** 2)) / (4 * Math.PI * slope ** 2 * Math.sqrt(nl * nv)) : 0;
      for (let c = 0; c < 3; c++) {
        const [d, s] = [[kd, this.colorspaces.kd], [ks, this.colorspaces.ks]].map(
          ([map, space]) => (space === 1 ? decoded(map[k + c] / 255) : map[k + c] / 255));
        out.data[k + c] = 255 * ((d / Math.PI + s * lobe) * Math.max(nl, 0)) ** (1 / 2.2);
      }
      out.data[k + 3] = 255;
    }
    context.putImageData(out, 0, 0);
  }
}

class Viewer {
  constructor(element) {
    this.canvas = document.createElement('canvas');
    element.append(this.canvas);
    this.camera = {};
    this.controllers = [];
    this.pointerManager = { onEvent: (controller) => this.controllers.push(controller) };
  }

  addLayer(name, layer) {
    layer.drawn = () => layer.ready.then(() => {
      layer.draw(this.canvas);
      document.documentElement.dataset.ready = (Number(document.documentElement.dataset.ready) || 0) + 1;
    });
    layer.drawn();
  }
}

class ControllerPanZoom { constructor(camera, options) { Object.assign(this, { camera }, options); } }

window.OpenLIME = { Viewer, Layer, ControllerPanZoom };
