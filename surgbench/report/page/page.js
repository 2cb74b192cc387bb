"use strict";
// Whatever comes from records is put in as text or as an attribute's value, never as markup.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const SVG = "http://www.w3.org/2000/svg";
  const COLOURS = 8, DASHES = 3, SHOWN_AT_FIRST = 6;

  function element(name, attributes = {}, ...children) {
    return filled(document.createElement(name), attributes, children);
  }
  function drawing(name, attributes = {}, ...children) {
    return filled(document.createElementNS(SVG, name), attributes, children);
  }
  function filled(node, attributes, children) {
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    node.append(...children);
    return node;
  }
  const colour = (row) => `s${row % COLOURS} d${Math.floor(row / COLOURS) % DASHES}`;
  const number = (value, measure) => (value === null ? "–" : value.toFixed(measure.decimals));
  const heading = (measure) => (measure.unit ? `${measure.name} [${measure.unit}]` : measure.name);

  // Tables: sorted by any column, filtered by text and status.

  const tables = [...document.querySelectorAll("#leaderboard table, #further table")];

  function sortable(table) {
    const heads = [...table.tHead.rows[0].cells];
    const body = table.tBodies[0];
    const before = [...body.rows];
    heads.forEach((head, column) => {
      head.querySelector("button").addEventListener("click", () => {
        const now = head.getAttribute("aria-sort");
        const next = { none: "ascending", ascending: "descending", descending: "none" }[now];
        heads.forEach((other) => other.setAttribute("aria-sort", "none"));
        head.setAttribute("aria-sort", next);
        const rows = next === "none" ? before : [...before].sort(comparison(column, next === "ascending" ? 1 : -1));
        body.append(...rows);
      });
    });
  }

  // Cells without a value are last, whichever way the others are.
  function comparison(column, sign) {
    return (one, other) => {
      const [a, b] = [one.cells[column], other.cells[column]];
      const [x, y] = [a.dataset.sort, b.dataset.sort];
      if (x !== undefined && y !== undefined) return sign * (Number(x) - Number(y));
      if (x !== undefined || y !== undefined) return x === undefined ? 1 : -1;
      return sign * a.textContent.trim().localeCompare(b.textContent.trim(), undefined, { numeric: true });
    };
  }

  function filterable() {
    const form = document.getElementById("filters");
    const [text, status, columns] = ["text", "status", "columns"].map((name) => document.getElementById(`filter-${name}`));
    const count = document.getElementById("filter-count");
    const rows = [...document.querySelectorAll("#leaderboard tbody tr")];
    // Only what is read at first is searched, so that a hit can be seen.
    const texts = new Map(rows.map((row) => [row, [...row.cells].map((cell) => cell.textContent).join(" ").toLowerCase()]));
    function filter() {
      const words = text.value.toLowerCase().split(/\s+/).filter(Boolean);
      let shown = 0;
      for (const row of rows) {
        const fits = words.every((word) => texts.get(row).includes(word));
        row.hidden = !fits || (status.value !== "" && row.dataset.status !== status.value);
        shown += row.hidden ? 0 : 1;
      }
      for (const board of document.querySelectorAll("#leaderboard .board")) {
        board.hidden = !board.querySelector("tbody tr:not([hidden])");
      }
      count.textContent = shown === rows.length ? `${rows.length} rows` : `${shown} of ${rows.length} rows`;
    }
    function widen() {
      for (const cell of document.querySelectorAll(".further")) cell.hidden = !columns.checked;
    }
    form.addEventListener("submit", (event) => event.preventDefault());
    text.addEventListener("input", filter);
    status.addEventListener("change", filter);
    columns.addEventListener("change", widen);
    form.hidden = false;
    filter();
    widen();
    return () => { text.value = ""; status.value = ""; filter(); };
  }

  // Axes.

  function ticks(low, high, most) {
    const rough = (high - low) / Math.max(1, most);
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((one) => one * power).find((one) => one >= rough);
    const found = [];
    for (let place = Math.ceil(low / step - 1e-9); place * step <= high + step * 1e-9; place++) found.push(place * step);
    return found;
  }
  function logTicks(low, high, most) {
    const found = [];
    for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power++) {
      for (const digit of [1, 2, 5]) found.push(digit * 10 ** power);
    }
    const inside = found.filter((one) => one >= low * 0.999 && one <= high * 1.001);
    if (inside.length < 3) return ticks(low, high, most);
    const decades = inside.filter((one) => Math.abs(Math.log10(one) - Math.round(Math.log10(one))) < 1e-9);
    return inside.length <= most || decades.length < 2 ? inside : decades;
  }
  const label = (value) => String(Number(value.toPrecision(6)));

  function axis(low, high, log) {
    if (log) {
      const [a, b] = [Math.log(low), Math.log(high)];
      return { at: (value) => (Math.log(value) - a) / (b - a), ticks: (most) => logTicks(low, high, most), low, high };
    }
    return { at: (value) => (value - low) / (high - low), ticks: (most) => ticks(low, high, most), low, high };
  }

  // A frame with both axes; what gives places in it.
  function frame(host, title, height, x, y, names) {
    const width = Math.max(260, host.clientWidth);
    const box = { left: 62, right: width - 14, top: 26, bottom: height - 44 };
    const svg = drawing("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": title });
    const at = {
      x: (value) => box.left + (box.right - box.left) * x.at(value),
      y: (value) => box.bottom - (box.bottom - box.top) * y.at(value),
    };
    const grid = drawing("g", { "aria-hidden": "true" });
    for (const value of y.ticks(6)) {
      const place = at.y(value);
      grid.append(drawing("line", { class: "grid", x1: box.left, x2: box.right, y1: place, y2: place }));
      grid.append(drawing("text", { x: box.left - 8, y: place + 4, "text-anchor": "end" }, label(value)));
    }
    for (const value of x.ticks(Math.floor((box.right - box.left) / 70))) {
      const place = at.x(value);
      grid.append(drawing("line", { class: "grid", x1: place, x2: place, y1: box.top, y2: box.bottom }));
      grid.append(drawing("text", { x: place, y: box.bottom + 18, "text-anchor": "middle" }, label(value)));
    }
    grid.append(drawing("line", { class: "axis", x1: box.left, x2: box.right, y1: box.bottom, y2: box.bottom }));
    grid.append(drawing("text", { x: box.right, y: height - 6, "text-anchor": "end" }, names.x));
    grid.append(drawing("text", { x: 4, y: 14 }, names.y));
    svg.append(grid);
    return { svg, at, box };
  }

  // Choosing: a list for each thing there are several of.
  function choice(host, id, name, options, changed) {
    const list = element("select", { id });
    options.forEach((text, place) => list.append(element("option", { value: place }, text)));
    const part = element("p", {}, element("label", { for: id }, name), list);
    list.addEventListener("change", changed);
    host.append(part);
    return {
      get value() { return Number(list.value); },
      refill(texts) {
        list.replaceChildren(...texts.map((text, place) => element("option", { value: place }, text)));
      },
      only(several) { part.hidden = !several; },
    };
  }
  function nothing(host, text) {
    host.replaceChildren(element("p", { class: "note" }, text));
  }
  function redrawn(host, draw) {
    let width = host.clientWidth;
    new ResizeObserver(() => {
      if (host.clientWidth !== width) { width = host.clientWidth; draw(); }
    }).observe(host);
    draw();
  }

  // Accuracy against latency.

  function scatter() {
    const host = document.getElementById("scatter");
    const boards = data.boards.filter((board) => board.scatter.points.length && board.scatter.measures.length);
    if (!boards.length) return nothing(host, "No row has both an error and a latency.");
    const choices = document.getElementById("scatter-choices");
    const which = choice(choices, "scatter-board", "Table", boards.map((board) => board.title), () => { refill(); draw(); });
    const error = choice(choices, "scatter-measure", "Error", [], () => draw());
    which.only(boards.length > 1);
    const refill = () => error.refill(boards[which.value].scatter.measures.map(heading));
    refill();
    function draw() {
      const board = boards[which.value];
      const measure = board.scatter.measures[error.value];
      const points = board.scatter.points.filter((one) => one.y[error.value] !== null);
      const xs = points.map((one) => one.x), ys = points.map((one) => one.y[error.value]);
      const x = axis(Math.min(...xs) / 1.6, Math.max(...xs) * 1.6, true);
      const y = axis(0, Math.max(...ys, 1e-9) * 1.15, false);
      const names = { x: "latency [ms], logarithmic", y: heading(measure) };
      const { svg, at, box } = frame(host, `${heading(measure)} against latency: ${board.title}`, 380, x, y, names);
      const taken = [];
      for (const point of points) {
        const row = board.rows.findIndex((one) => one.place === point.row);
        const { name, anchor } = board.rows[row];
        const [left, top] = [at.x(point.x), at.y(point.y[error.value])];
        const said = `${name}: ${number(point.y[error.value], measure)} ${measure.unit} at ${point.x} ms${point.floor ? ", a floor" : ""}`;
        const right = left < (box.left + box.right) / 2;
        // Names that would stand on each other are left to the titles.
        const space = { left: right ? left : left - 9 * name.length, right: right ? left + 9 * name.length : left, top };
        const free = taken.every((one) => one.right < space.left || one.left > space.right || Math.abs(one.top - top) > 16);
        const link = drawing("a", { href: `#${anchor}`, "aria-label": said, class: `point ${colour(row)}` },
          drawing("title", {}, said),
          drawing("circle", { class: "target", cx: left, cy: top, r: 13 }),
          drawing("circle", { class: "ring", cx: left, cy: top, r: 10 }),
          drawing("circle", { class: point.floor ? "spot floor" : "spot", cx: left, cy: top, r: 6.5 }));
        if (free) {
          taken.push(space);
          const place = { x: left + (right ? 12 : -12), y: top + 4, "text-anchor": right ? "start" : "end", class: "name" };
          link.append(drawing("text", place, name.length > 40 ? `${name.slice(0, 39)}…` : name));
        }
        svg.append(link);
      }
      host.replaceChildren(svg);
    }
    redrawn(host, draw);
  }

  // Errors over time.

  const SHAPES = { best: "M-7,-6 L7,-6 L0,7 Z", median: "M0,-8 L8,0 L0,8 L-8,0 Z", worst: "M-7,6 L7,6 L0,-7 Z" };

  function curves() {
    const host = document.getElementById("curves");
    const boards = data.boards.filter((board) => board.units.length && board.measures.length);
    if (!boards.length) return nothing(host, "No run has errors over time.");
    const choices = document.getElementById("curve-choices");
    const which = choice(choices, "curve-board", "Table", boards.map((board) => board.title), () => { refill(); draw(); });
    const unit = choice(choices, "curve-unit", "Sequence", [], () => { hide(); draw(); });
    const measure = choice(choices, "curve-measure", "Error", [], () => draw());
    const log = element("input", { type: "checkbox", id: "curve-log" });
    log.addEventListener("change", () => draw());
    choices.append(element("p", { class: "check" }, log, element("label", { for: "curve-log" }, "Logarithmic")));
    choices.classList.add("filters");
    which.only(boards.length > 1);
    const left_out = element("p", { class: "note" });
    choices.after(left_out);
    let unseen = new Set();

    function refill() {
      const board = boards[which.value];
      unit.refill(board.units);
      measure.refill(board.measures.map(heading));
      unseen = new Set(board.rows.slice(SHOWN_AT_FIRST).map((_, row) => row + SHOWN_AT_FIRST));
      left_out.textContent = board.units.length < board.unitsOfAll
        ? `There is room for ${board.units.length} of the ${board.unitsOfAll} sequences.` : "";
      left_out.hidden = board.units.length === board.unitsOfAll;
      legend(board);
      hide();
    }
    function legend(board) {
      const items = board.rows.map((row, place) => {
        const box = element("input", { type: "checkbox", id: `line-${place}` });
        box.checked = !unseen.has(place);
        box.addEventListener("change", () => { box.checked ? unseen.delete(place) : unseen.add(place); draw(); });
        const sample = drawing("svg", { width: 34, height: 12, "aria-hidden": "true", class: colour(place) },
          drawing("line", { class: `curve ${colour(place)}`, x1: 0, x2: 34, y1: 6, y2: 6 }));
        return element("li", {}, box, sample, element("label", { for: `line-${place}` }, row.name));
      });
      const list = element("ul", { class: "legend", "aria-label": "Rows that are drawn" }, ...items);
      document.getElementById("curve-legend").replaceChildren(list);
    }

    function draw() {
      const board = boards[which.value];
      const chosen = board.measures[measure.value];
      const runs = board.runs.filter((run) => run.unit === unit.value).map((run) => ({
        ...run, order: board.rows.findIndex((row) => row.place === run.row), line: run.lines[measure.value],
      }));
      const seen = runs.filter((run) => run.line && !unseen.has(run.order));
      tell(board, runs, chosen);
      if (!seen.length) return nothing(host, "None of the rows that are ticked has this here.");
      const xs = seen.flatMap((run) => [run.line.x[0], run.line.x[run.line.x.length - 1]]);
      let [low, high] = [Infinity, -Infinity];
      for (const run of seen) for (const value of run.line.y) {
        if (!log.checked || value > 0) { low = Math.min(low, value); high = Math.max(high, value); }
      }
      if (!(high > -Infinity)) [low, high] = [1, 10];
      const y = log.checked ? axis(low / 1.2, Math.max(high, low * 1.01) * 1.2, true)
        : axis(Math.min(0, low), Math.max(high * 1.06, low + 1e-9, 1e-9), false);
      const x = axis(Math.min(...xs), Math.max(...xs, Math.min(...xs) + 1), false);
      const title = `${heading(chosen)} over frames of ${board.units[unit.value]}`;
      const { svg, at } = frame(host, title, 360, x, y, { x: "frame", y: heading(chosen) });
      const place = (frame_, value) => `${at.x(frame_).toFixed(1)},${at.y(log.checked ? Math.max(value, y.low) : value).toFixed(1)}`;
      for (const run of seen) {
        const path = run.line.x.map((frame_, at_) => place(frame_, run.line.y[at_])).join(" ");
        svg.append(drawing("polyline", { class: `curve ${colour(run.order)}`, points: path }, drawing("title", {}, board.rows[run.order].name)));
      }
      for (const run of seen) for (const moment of run.moments) {
        const value = moment.values[measure.value];
        if (value === null) continue;
        const name = board.rows[run.order].name;
        const said = `${moment.kind} moment of ${name}, frame ${moment.frame}: ${moment.text}`;
        const mark = drawing("g", { role: "button", tabindex: 0, "aria-label": said, class: colour(run.order),
          "data-picture": moment.picture, transform: `translate(${place(moment.frame, value)})` },
          drawing("title", {}, said), drawing("circle", { class: "target", r: 13 }),
          drawing("circle", { class: "ring", r: 12 }), drawing("path", { class: "mark", d: SHAPES[moment.kind] || SHAPES.median }));
        const show = () => picture(moment, said, mark);
        mark.addEventListener("click", show);
        mark.addEventListener("focus", show);
        mark.addEventListener("keydown", (event) => {
          if (event.key === "Enter" || event.key === " ") { event.preventDefault(); show(); }
        });
        svg.append(mark);
      }
      host.replaceChildren(svg);
    }

    // The same in words and figures, for whoever does not see the lines.
    function tell(board, runs, chosen) {
      const kinds = ["best", "median", "worst"];
      const first = heading(board.measures[0]);
      const head = element("tr", {}, ...["row", `mean ${heading(chosen)}`, ...kinds.map((kind) => `${kind} frame by ${first}`)]
        .map((text, place) => element("th", { scope: "col", class: place === 1 ? "number plain" : "plain" }, text)));
      const rows = runs.map((run) => {
        const name = board.rows[run.order].name;
        const cells = kinds.map((kind) => {
          const moment = run.moments.find((one) => one.kind === kind);
          if (!moment) return element("td", {}, "–");
          const button = element("button", { type: "button", class: "show" }, `frame ${moment.frame}: ${moment.text}`);
          button.addEventListener("click", () => picture(moment, `${kind} moment of ${name}, frame ${moment.frame}: ${moment.text}`));
          return element("td", {}, button);
        });
        const mean = element("td", { class: "number" }, run.line ? number(run.line.mean, chosen) : "–");
        return element("tr", {}, element("th", { scope: "row", class: "text" }, name), mean, ...cells);
      });
      const title = `${board.units[unit.value]} in figures`;
      const table = element("table", {}, element("caption", { class: "unseen" }, title), element("thead", {}, head), element("tbody", {}, ...rows));
      const region = element("div", { class: "scroll", role: "region", tabindex: 0, "aria-label": title }, table);
      document.getElementById("curve-table").replaceChildren(region);
    }
    refill();
    redrawn(host, draw);
  }

  const shown = document.getElementById("shown");
  function hide() {
    shown.hidden = true;
    shown.replaceChildren();
  }
  function picture(moment, said, mark) {
    for (const other of document.querySelectorAll("#curves .chosen")) other.classList.remove("chosen");
    (mark || document.querySelector(`#curves [data-picture="${moment.picture}"]`))?.classList.add("chosen");
    const figure = document.getElementById(moment.picture);
    const still = figure && figure.querySelector("img");
    const caption = element("figcaption", {}, said);
    if (still) {
      const link = element("a", { href: `#${moment.picture}` }, figure.querySelector("video") ? "with its film, among the moments" : "among the moments");
      caption.append(". ", link);
      shown.replaceChildren(element("img", { src: still.src, alt: said, width: still.getAttribute("width"), height: still.getAttribute("height") }), caption);
    } else {
      caption.append(". There is no picture of it on this page.");
      shown.replaceChildren(caption);
    }
    shown.hidden = false;
  }

  // Pictures with small print are shown large where there is room for it.
  function enlargeable(figure) {
    const still = figure.querySelector("img");
    if (!still || Number(still.getAttribute("width")) < 700) return;
    const button = element("button", { type: "button", class: "larger", "aria-pressed": "false" }, "larger");
    button.setAttribute("aria-label", `larger: ${still.alt}`);
    button.addEventListener("click", () => {
      button.setAttribute("aria-pressed", String(figure.classList.toggle("large")));
    });
    figure.querySelector("figcaption").append(button);
  }

  // Links lead to what may be folded or filtered away.
  function reveal(unfilter) {
    const target = location.hash.length > 1 && document.getElementById(location.hash.slice(1));
    if (!target) return;
    const row = target.closest("tbody tr");
    if (row && (row.hidden || row.closest(".board")?.hidden)) unfilter();
    const fold = target.closest("details");
    if (fold) {
      fold.open = true;
      fold.querySelector("summary").focus({ preventScroll: true });
    } else if (row) row.focus({ preventScroll: true });
    target.scrollIntoView({ block: row ? "center" : "start" });
  }

  tables.forEach(sortable);
  const unfilter = filterable();
  document.querySelectorAll(".sheet figure").forEach(enlargeable);
  scatter();
  curves();
  addEventListener("hashchange", () => reveal(unfilter));
  reveal(unfilter);
})();
