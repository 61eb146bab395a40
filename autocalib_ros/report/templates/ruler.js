// The ruler: two clicks on a picture read the length between them on the road, and its standard deviation.
(function () {
  'use strict';
  const data = JSON.parse(document.getElementById('ruler-data').textContent);
  const SVG = document.getElementById('ruler-image').namespaceURI;

  function series(k, t2) { return 1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))); }

  // Road point of a pixel; null at and above the horizon. The inverse of r = f (theta + k1 theta^3 + ...) by bisection.
  function ground(c, u, v) {
    const dx = (u - c[1]) * c[7] - (v - c[2]) * c[8], dy = v - c[2], r = Math.hypot(dx, dy) / c[0], k = c.slice(3, 7);
    let low = 0, high = Math.PI / 2 * 1.2;
    for (let i = 0; i < 60; i++) {
      const t = (low + high) / 2;
      if (t * series(k, t * t) < r) { low = t; } else { high = t; }
    }
    const scale = r > 1e-12 ? Math.sin(low) / (r * c[0]) : 0, b = [scale * dx, scale * dy, Math.cos(low)];
    const ray = [0, 1, 2].map(i => c[9 + 3 * i] * b[0] + c[10 + 3 * i] * b[1] + c[11 + 3 * i] * b[2]);
    if (ray[2] > -1e-4) { return null; }
    const s = -c[20] / ray[2];
    return [c[18] + s * ray[0], c[19] + s * ray[1]];
  }

  function pixel(c, x, y) {
    const d = [x - c[18], y - c[19], -c[20]];
    const b = [0, 1, 2].map(j => c[9 + j] * d[0] + c[12 + j] * d[1] + c[15 + j] * d[2]);
    const across = Math.hypot(b[0], b[1]), t = Math.atan2(across, b[2]), k = c.slice(3, 7);
    const scale = across > 1e-12 ? c[0] * t * series(k, t * t) / across : 0, dy = scale * b[1];
    return [(scale * b[0] + c[8] * dy) / c[7] + c[1], dy + c[2]];
  }

  function distance(c, p, q) {
    const a = ground(c, p[0], p[1]), b = ground(c, q[0], q[1]);
    return a && b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : null;
  }

  // Length between two pixels and its standard deviation: of the calibration and of the clicks.
  function measure(p, q) {
    const length = distance(data.cameras[0], p, q);
    if (length === null) { return null; }
    let variance = 0;
    for (let i = 1; i + 1 < data.cameras.length; i += 2) {
      const sides = [distance(data.cameras[i], p, q), distance(data.cameras[i + 1], p, q)];
      if (sides[0] === null || sides[1] === null) { return [length, null]; }
      variance += Math.pow((sides[0] - sides[1]) / (2 * data.sigmas), 2);
    }
    for (const [one, axis] of [[0, 0], [0, 1], [1, 0], [1, 1]]) {
      const ends = [p.slice(), q.slice()];
      ends[one][axis] += data.click_px;
      const moved = distance(data.cameras[0], ends[0], ends[1]);
      if (moved === null) { return [length, null]; }
      variance += Math.pow(moved - length, 2);
    }
    return [length, data.cameras.length > 1 ? Math.sqrt(variance) : null];
  }

  function element(name, attributes, parent) {
    const one = document.createElementNS(SVG, name);
    for (const key in attributes) { one.setAttribute(key, attributes[key]); }
    parent.appendChild(one);
    return one;
  }

  // A picture of `size`; toPixel takes a place in it to a pixel of the camera's image.
  function attach(id, size, href, toPixel) {
    const svg = document.getElementById(id), out = document.getElementById(id + '-length'), ends = [];
    svg.setAttribute('viewBox', `0 0 ${size[0]} ${size[1]}`);
    element('image', {href: href, width: size[0], height: size[1], preserveAspectRatio: 'none'}, svg);
    const drawn = element('g', {}, svg), width = size[0] / 400;
    svg.addEventListener('click', event => {
      const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
      if (ends.length === 2) { ends.length = 0; }
      ends.push([at.x, at.y]);
      drawn.replaceChildren();
      for (const end of ends) {
        element('circle', {cx: end[0], cy: end[1], r: 2.5 * width, class: 'end'}, drawn);
      }
      if (ends.length < 2) { out.textContent = 'Now the other end.'; return; }
      element('line', {x1: ends[0][0], y1: ends[0][1], x2: ends[1][0], y2: ends[1][1], class: 'length',
                       'stroke-width': width}, drawn);
      const found = measure(toPixel(ends[0]), toPixel(ends[1]));
      out.textContent = found === null ? 'One end is at or above the horizon.'
        : `${found[0].toFixed(2)} m` + (found[1] === null ? '' : ` ± ${found[1].toFixed(2)} m (1 sigma)`);
    });
  }

  window.autocalibRuler = measure;
  const camera = data.cameras[0];
  attach('ruler-image', data.size, data.image, p => [p[0] - 0.5, p[1] - 0.5]);
  if (data.top) {
    const top = data.top;
    attach('ruler-top', top.size, top.image, p => pixel(camera,
      top.low[0] + p[0] / top.size[0] * (top.high[0] - top.low[0]),
      top.high[1] - p[1] / top.size[1] * (top.high[1] - top.low[1])));
  }
})();
