'use strict';
(function () {
  const figures = JSON.parse(document.getElementById('figures').textContent);
  // A4 less its margins, in the browser's pixels of 1/96 inch.
  const paperWidth = 685;
  let printing = false;

  function layout(figure, colour, narrow) {
    const given = figure.layout;
    const named = figure.data.filter((t) => t.name && t.showlegend !== false).length;
    const out = painted(given, colour);
    const base = Object.assign(baseLayout(colour), {
      margin: { l: 60, r: 12, t: narrow || printing ? 34 : 46, b: 50 }, dragmode: narrow ? false : 'zoom',
    });
    // There the entries of a legend stand one below the other, and need their own room.
    if (narrow) out.height += 22 * Math.max(0, named - 1);
    for (const key of Object.keys(out)) {
      base[key] = /^[xy]axis/.test(key) ? styledAxis(out[key], colour, narrow) : out[key];
    }
    return base;
  }

  function draw() {
    const colour = colours();
    const narrow = window.innerWidth < 560;
    const settings = {
      responsive: !printing, displaylogo: false, displayModeBar: narrow || printing ? false : 'hover',
      // A list of our own: the usual one has a button that sends the data to a server.
      modeBarButtons: [['toImage'], ['zoom2d', 'pan2d'], ['resetScale2d']],
      toImageButtonOptions: { format: 'svg' }, plotlyServerURL: '', showSendToCloud: false,
    };
    const jobs = Object.keys(figures).map((name) => {
      const place = document.getElementById(name);
      const waiting = place.querySelector('.waiting');
      if (waiting) waiting.remove();
      const look = layout(figures[name], colour, narrow);
      if (printing) Object.assign(look, { width: paperWidth, height: Math.min(0.8 * look.height, 400) });
      place.style.height = look.height + 'px';
      return Plotly.react(place, painted(figures[name].data, colour), look, settings);
    });
    return Promise.all(jobs);
  }

  function sorry(reason) {
    for (const place of document.querySelectorAll('.waiting')) {
      place.textContent = 'The picture cannot be drawn by this browser (' + reason + ').';
    }
  }

  async function unpack() {
    const text = document.getElementById('library').textContent;
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
    const script = document.createElement('script');
    script.textContent = await new Response(stream).text();
    document.head.appendChild(script);
  }

  function print(on) {
    printing = on;
    // On paper nobody can open anything.
    for (const folded of document.querySelectorAll('details')) folded.open = on;
    document.documentElement.classList.toggle('printing', on);
    draw();
  }

  async function begin() {
    if (typeof DecompressionStream === 'undefined') {
      sorry('it cannot unpack compressed data; a version from 2023 or later can');
      return;
    }
    try {
      await unpack();
      await draw();
      document.documentElement.dataset.drawn = 'yes';
    } catch (error) {
      sorry(error.message);
      throw error;
    }
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', draw);
    window.addEventListener('beforeprint', () => print(true));
    window.addEventListener('afterprint', () => print(false));
  }

  begin();
})();
