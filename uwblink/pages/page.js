(() => {
const tip = document.getElementById('tip'), zoom = document.getElementById('zoom');
const where = (svg, event) => { const p = new DOMPoint(event.clientX, event.clientY);
  return p.matrixTransform(svg.getScreenCTM().inverse()); };
const at = (from, to, share, scale) => scale === 'log' ? from * Math.pow(to / from, share) : from + (to - from) * share;
const short = (value, from, to) => { const step = Math.abs(to - from) / 200;
  return step > 0 ? value.toFixed(Math.min(8, Math.max(0, Math.ceil(-Math.log10(step))))) : value.toPrecision(4); };
const reading = (svg, event) => {
  const p = where(svg, event);
  for (const {box, x, y, scale, names} of svg.panels ??= JSON.parse(svg.dataset.panels || '[]')) {
    const u = (p.x - box[0]) / (box[2] - box[0]), v = (box[3] - p.y) / (box[3] - box[1]);
    if (u >= 0 && u <= 1 && v >= 0 && v <= 1)
      return [names[0] + ': ' + short(at(x[0], x[1], u, scale[0]), x[0], x[1]),
        names[1] + ': ' + short(at(y[0], y[1], v, scale[1]), y[0], y[1])];
  }
  return [];
};
document.addEventListener('pointermove', event => {
  const svg = event.target.closest?.('svg[data-panels]');
  document.querySelectorAll('svg.one').forEach(other => { if (other !== svg) other.classList.remove('one'); });
  if (!svg) { tip.style.display = 'none'; return; }
  const series = event.target.closest('.series');
  svg.querySelectorAll('.series.here').forEach(one => one.classList.remove('here'));
  svg.classList.toggle('one', !!series);
  if (series) svg.querySelectorAll('.series').forEach(one => {
    one.classList.toggle('here', one.dataset.name === series.dataset.name); });
  const lines = [...(series ? [series.dataset.name] : []), ...reading(svg, event).filter(line => line[0] !== ':')];
  tip.replaceChildren(...lines.map(line => { const one = document.createElement('div');
    one.textContent = line; return one; }));
  tip.style.display = lines.length ? 'block' : 'none';
  const room = tip.getBoundingClientRect();
  tip.style.left = Math.max(4, Math.min(event.clientX + 14, innerWidth - room.width - 4)) + 'px';
  tip.style.top = Math.min(event.clientY + 14, innerHeight - room.height - 4) + 'px';
});
const closer = svg => {
  const copy = svg.cloneNode(true), full = svg.viewBox.baseVal;
  let view = [full.x, full.y, full.width, full.height];
  const shown = () => copy.setAttribute('viewBox', view.join(' '));
  copy.addEventListener('wheel', event => { event.preventDefault();
    const p = where(copy, event), k = Math.exp(event.deltaY * 0.0015);
    const size = Math.min(full.width, Math.max(full.width / 40, view[2] * k)) / view[2];
    view = [p.x - (p.x - view[0]) * size, p.y - (p.y - view[1]) * size, view[2] * size, view[3] * size]; shown();
  }, {passive: false});
  copy.addEventListener('pointermove', event => { if (!event.buttons) return;
    const m = copy.getScreenCTM(); view[0] -= event.movementX / m.a; view[1] -= event.movementY / m.d; shown(); });
  copy.addEventListener('dblclick', () => { view = [full.x, full.y, full.width, full.height]; shown(); });
  zoom.querySelector('div').replaceChildren(copy); zoom.showModal(); zoom.append(tip);
};
zoom.addEventListener('close', () => { document.body.append(tip); zoom.querySelector('div').replaceChildren(); });
document.querySelectorAll('figure .wide svg').forEach(svg => svg.addEventListener('click', () => closer(svg)));
})();
