"use strict";
(() => {
  const data = JSON.parse(document.getElementById("report-data").textContent);
  const touch = matchMedia("(pointer: coarse)").matches;
  const config = {responsive: true, displaylogo: false, displayModeBar: false, scrollZoom: false};
  document.documentElement.classList.add("live");

  // What is far below is drawn when one comes near it, so that the page opens at once.
  const waiting = new Map();
  const observer = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      observer.unobserve(entry.target);
      waiting.get(entry.target)(entry.target);
      waiting.delete(entry.target);
    }
  }, {rootMargin: "300px"});
  const later = (element, draw) => {
    waiting.set(element, draw);
    observer.observe(element);
  };

  const goTo = (id) => {
    if (id) location.hash = id;
  };

  const drawPlot = (element) => {
    const plot = data.plots[element.dataset.plot];
    const equal = Boolean(plot.layout.yaxis.scaleanchor);
    // A drag on a touch screen scrolls the page.
    if (touch) plot.layout.dragmode = false;
    Plotly.newPlot(element, plot.data, plot.layout, {...config, scrollZoom: equal && !touch});
    element.on("plotly_click", (event) => goTo(event.points[0].customdata));
  };
  for (const element of document.querySelectorAll(".plot")) {
    const plot = data.plots[element.dataset.plot];
    const width = element.clientWidth;
    const height = plot.layout.yaxis.scaleanchor
      ? Math.min(0.75 * width + 60, 640) : Math.max(170, Math.min(300, 0.62 * width + 60) * plot.height);
    element.style.height = `${Math.round(height)}px`;
    later(element, drawPlot);
  }

  const unpacked = (text, model) => {
    const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const numbers = new DataView(bytes.buffer);
    const count = bytes.length / 6;
    const axes = [0, 1, 2].map(() => new Float32Array(count));
    for (let i = 0; i < count; i++) {
      for (let axis = 0; axis < 3; axis++) {
        axes[axis][i] = model.origin[axis] + model.step * numbers.getUint16(6 * i + 2 * axis, true);
      }
    }
    return axes;
  };

  // Darker below, paler above: flat colours would show no depth.
  const shade = (colour, white) => {
    const parts = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
    const mixed = parts.map((c) => Math.round(white < 0 ? c * (1 + white) : c + (255 - c) * white));
    return `rgb(${mixed.join(",")})`;
  };

  const cloud = (text, model, colour) => {
    const [x, y, z] = unpacked(text, model);
    return {type: "scatter3d", mode: "markers", x, y, z, hoverinfo: "skip",
      marker: {size: 1.6, opacity: 1, line: {width: 0}, showscale: false, color: z,
        cmin: model.origin[2], cmax: model.origin[2] + model.extent[2],
        colorscale: [[0, shade(colour, -0.45)], [0.5, colour], [1, shade(colour, 0.45)]]}};
  };

  const spots = (stage) => ({
    type: "scatter3d", mode: "markers", text: stage.spots.map((spot) => spot[0]),
    x: stage.spots.map((spot) => spot[1]), y: stage.spots.map((spot) => spot[2]),
    z: stage.spots.map((spot) => spot[3]), hovertemplate: "%{text}<extra></extra>",
    marker: {size: 6, symbol: "diamond", color: stage.colour, line: {width: 2, color: "#111"}},
  });

  const hasWebGl = () => {
    try {
      return Boolean(document.createElement("canvas").getContext("webgl"));
    } catch {
      return false;
    }
  };

  for (const element of document.querySelectorAll(".model")) {
    const models = element.dataset.maps.split(" ").map((name) => data.maps[name]);
    const view = element.querySelector(".view");
    const choice = element.querySelector("select");
    const range = element.querySelector("input[type=range]");
    const label = element.querySelector("output");
    const ceiling = element.querySelector(".ceiling");
    const marks = element.querySelector(".spots");
    let model = models[0];
    let drawn = false;
    for (const each of models) choice.add(new Option(each.name));

    const visible = () => model.stages.flatMap((_, i) => {
      const on = Number(range.value) === model.stages.length || Number(range.value) === i;
      return [on, on && ceiling.checked, on && marks.checked];
    });
    const update = () => {
      const stage = model.stages[Number(range.value)];
      label.textContent = stage ? `Stage ${stage.stage}` : `All ${model.stages.length} stages`;
      range.setAttribute("aria-valuetext", label.textContent);
      if (stage) {
        const chip = document.createElement("i");
        chip.style.background = stage.colour;
        label.prepend(chip);
      }
      if (drawn) Plotly.restyle(view, {visible: visible()});
    };
    for (const control of [range, ceiling, marks]) control.addEventListener("input", update);

    const draw = () => {
      const shown = visible();
      const traces = model.stages.flatMap((stage) => [
        cloud(stage.below, model, stage.colour), cloud(stage.above, model, stage.colour), spots(stage),
      ]);
      traces.forEach((trace, i) => { trace.visible = shown[i]; });
      const axis = (title) => ({title: {text: title}, backgroundcolor: "#fff", gridcolor: "#e8eaed",
        zeroline: false, showspikes: false});
      const [w, d, h] = model.extent;
      const far = Math.max(1, 1.3 * view.clientHeight / view.clientWidth);
      const range3d = (i) => [model.origin[i], model.origin[i] + model.extent[i]];
      // Another map is seen from the start, not from where the last one was left.
      Plotly.react(view, traces, {
        showlegend: false, margin: {l: 0, r: 0, t: 0, b: 0}, uirevision: model.name,
        scene: {
          aspectmode: "data", dragmode: "turntable",
          xaxis: {...axis("x (m)"), range: range3d(0)}, yaxis: {...axis("y (m)"), range: range3d(1)},
          zaxis: {...axis("z (m)"), range: range3d(2), nticks: h < 0.5 * Math.max(w, d) ? 4 : 8},
          camera: {eye: {x: -0.85 * far, y: -1.5 * far, z: 1.35 * far}, center: {x: 0.02, y: -0.02, z: -0.36}},
        },
      }, {...config, scrollZoom: true});
      drawn = true;
    };
    const choose = () => {
      model = models[choice.selectedIndex];
      // One stage at a time, and all of them at the end.
      range.max = model.stages.length === 1 ? 0 : model.stages.length;
      range.value = range.max;
      const redraw = drawn;
      drawn = false;
      update();
      if (redraw) draw();
    };
    choice.addEventListener("input", choose);
    choose();

    later(view, () => {
      if (hasWebGl()) {
        draw();
        return;
      }
      view.textContent = "This browser shows no 3-D graphics; the pictures below show the map.";
      view.classList.add("missing");
    });
  }

  // Paper has no use for what is folded.
  const folded = [...document.querySelectorAll("details.more")];
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = folded.filter((each) => !each.open);
    for (const each of opened) each.open = true;
  });
  addEventListener("afterprint", () => {
    for (const each of opened) each.open = false;
  });

  for (const section of document.querySelectorAll("section")) {
    const filters = section.querySelector(".filters");
    if (!filters) continue;
    const rows = [...section.querySelectorAll("tbody tr")];
    const buttons = [...filters.querySelectorAll("button")];
    const search = filters.querySelector("input");
    for (const row of rows) row.classList.add(row.cells[3].textContent.split(" ")[0]);
    const update = () => {
      const outcome = buttons.find((b) => b.getAttribute("aria-pressed") === "true").dataset.outcome;
      const words = search.value.toLowerCase();
      for (const row of rows) {
        row.hidden = (outcome && row.cells[3].textContent !== outcome)
          || (words && !row.textContent.toLowerCase().includes(words));
      }
    };
    const choose = (chosen) => {
      for (const each of buttons) each.setAttribute("aria-pressed", String(each === chosen));
      update();
    };
    for (const button of buttons) button.addEventListener("click", () => choose(button));
    search.addEventListener("input", update);
    addEventListener("hashchange", () => {
      const row = document.getElementById(location.hash.slice(1));
      if (row && row.hidden && section.contains(row)) {
        search.value = "";
        choose(buttons[0]);
        row.scrollIntoView();
      }
    });
  }
})();
