// The live page: pictures in the page's colours, and a word when the server is silent.
const valveflow = (function () {
  const silentAfter = 7000;
  let heard = Date.now();
  let generation = null;
  let last = null;

  // An axis that was scrolled or zoomed by hand stays as it is while new data come.
  function keepRanges(layout) {
    const id = window.dash_clientside.callback_context.outputs_list.id;
    const place = document.getElementById(JSON.stringify(id, Object.keys(id).sort()));
    const plot = place && place.querySelector('.js-plotly-plot');
    for (const name of plot && plot.layout ? ['xaxis', 'yaxis'] : []) {
      const before = plot.layout[name];
      if (before && before.autorange === false && before.range && layout[name].visible !== false) {
        Object.assign(layout[name], { autorange: false, range: before.range });
      }
    }
  }

  function picture(made, name) {
    if (!made || !made[name]) return window.dash_clientside.no_update;
    const colour = colours();
    const narrow = window.innerWidth < 560;
    const given = painted(made[name], colour);
    const layout = Object.assign(baseLayout(colour), {
      uirevision: name, dragmode: narrow ? false : 'pan', autosize: true,
      margin: { l: 52, r: 10, t: narrow ? 46 : 28, b: narrow ? 40 : 44 },
    });
    for (const key of Object.keys(given.layout)) {
      layout[key] = /^[xy]axis/.test(key) ? styledAxis(given.layout[key], colour, narrow) : given.layout[key];
    }
    keepRanges(layout);
    document.documentElement.dataset.drawn = 'yes';
    return { data: given.data, layout };
  }

  function pulse(seen) {
    const now = Date.now();
    // A tick and a pulse may come as one: what was heard last is known by its number.
    const number = seen.generation + seen.tick;
    if (number !== last) {
      last = number;
      heard = now;
      generation = generation || seen.generation;
      // Other units, or a server that was started anew: nothing here can be relied on.
      if (seen.generation !== generation) window.location.reload();
    }
    const lost = now - heard > silentAfter;
    document.documentElement.classList.toggle('silent', lost);
    if (!lost) return '';
    const since = new Date(heard).toISOString().slice(11, 19);
    return 'No answer from the page\'s process since ' + since + ' UTC: what stands here is old. It is asked again by itself.';
  }

  // Colours are looked up when a picture is drawn.
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => window.location.reload());
  return { picture, pulse };
})();
