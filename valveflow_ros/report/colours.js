'use strict';
// Colours stand in the pictures by name; the page's style sheet has their values.
function colours() {
  const style = getComputedStyle(document.documentElement);
  return (name) => style.getPropertyValue('--' + name).trim() || '#888888';
}

// Give each colour its value in the page's present look.
function painted(value, colour) {
  if (typeof value === 'string') {
    return value.startsWith('token:') ? colour(value.slice(6)) : value;
  }
  if (Array.isArray(value)) {
    const last = value[value.length - 1];
    return typeof last === 'number' ? value : value.map((v) => painted(v, colour));
  }
  if (value !== null && typeof value === 'object') {
    const out = {};
    for (const key of Object.keys(value)) out[key] = painted(value[key], colour);
    return out;
  }
  return value;
}

// A long title would run out of a narrow picture.
function titled(given, narrow) {
  const title = Object.assign({ standoff: 8 }, given.title);
  if (narrow && title.short) title.text = title.short;
  delete title.short;
  return title;
}

function styledAxis(given, colour, narrow) {
  return Object.assign({
    gridcolor: colour('grid'), linecolor: colour('rule'), tickcolor: colour('rule'),
    zeroline: false, ticks: 'outside', automargin: true, hoverformat: given.hoverformat,
  }, given, { title: titled(given, narrow) });
}

// What every picture has in common.
function baseLayout(colour) {
  return {
    paper_bgcolor: colour('paper'), plot_bgcolor: colour('paper'),
    font: { family: getComputedStyle(document.body).fontFamily, size: 14, color: colour('ink') },
    hovermode: 'closest',
    legend: { orientation: 'h', x: 0, y: 1.02, xanchor: 'left', yanchor: 'bottom', itemsizing: 'constant', font: { size: 14 } },
    hoverlabel: { bgcolor: colour('panel'), bordercolor: colour('rule'), font: { color: colour('ink') } },
  };
}
