"use strict";
const D = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);
const two = (x) => (Math.abs(x) < 0.005 ? 0 : x).toFixed(2).replace("-", "\u2212");
const signed = (x) => (x >= 0.005 ? "+" : "") + two(x);
const range = (pair) => (pair ? `${two(pair[0])} to ${two(pair[1])}` : "one seed");
const seeds = (n) => `${n} seed${n > 1 ? "s" : ""}`;
const text = (s) => String(s).replace(/[&<>"]/g, (c) => `&#${c.charCodeAt(0)};`);
const breakable = (name) => text(name).replaceAll("_", "_<wbr>");
const swatch = (name) => `<span class="swatch" style="background:${D.methods[name].colour}"></span>`;
const where = (task, method) => D.rows.find((r) => r.task === task && r.method === method);
const MEASURES = { last: "Score in the last episode", first: "Score in the first episode", regret: "Regret, summed over episodes" };
const measured = (r, measure) => (r && measure !== "last" ? r[measure] : r); // of a row: its value and interval
const iqm = (f, measure) => (measure === "last" ? f.iqm : f[measure]);
const dash = (name) => (D.methods[name].deployment ? "2 3" : "exact reference".includes(D.methods[name].kind) ? "6 4" : "");
const extent = (xs) => [Math.min(...xs), Math.max(...xs)];
const tierOf = Object.fromEntries(D.tasks.map((t) => [t.name, t.tier]));

// ---- charts -------------------------------------------------------------------------------------------------------

// Of a chart, px: texts have one size whatever the screen.
const width = (box) => Math.max(Math.round(box.clientWidth), 280);

function ticks(low, high, n) {
  const raw = (high - low) / n, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= raw);
  const values = [];
  for (let x = Math.ceil(low / step - 1e-9) * step; x <= high + 1e-9 * step; x += step) values.push(+x.toPrecision(12));
  return values;
}

const nothing = (box) => { box.innerHTML = `<p class="soft">Nothing is chosen.</p>`; };

// series: {name, colour, dash, points: [x, y or null], band: [x, low, high]}; a null is a gap.
function lines(box, series, o) {
  if (!series.length) return nothing(box);
  const w = width(box), h = o.h || 250, left = 40, right = 16, top = 8, bottom = o.xlabel ? 34 : 20;
  const [x0, x1] = o.x, [y0, y1] = o.y;
  const X = (x) => left + ((x - x0) / (x1 - x0 || 1)) * (w - left - right);
  const Y = (y) => top + (1 - (Math.min(Math.max(y, y0), y1) - y0) / (y1 - y0 || 1)) * (h - top - bottom);
  let out = `<svg viewBox="0 0 ${w} ${h}" width="${w}" height="${h}" role="img" aria-label="${text(o.label)}" class="${series.length > 4 ? "many" : ""}">`;
  if (o.shade) out += `<rect x="${X(o.shade)}" y="${top}" width="${X(x1) - X(o.shade)}" height="${h - top - bottom}" fill="var(--ink)" opacity=".045"/>`;
  for (const y of ticks(y0, y1, 5))
    out += `<line class="grid" x1="${left}" x2="${w - right}" y1="${Y(y)}" y2="${Y(y)}"/><text x="${left - 6}" y="${Y(y) + 4}" text-anchor="end">${y}</text>`;
  for (const x of o.xticks || ticks(x0, x1, 5)) out += `<text x="${X(x)}" y="${h - bottom + 15}" text-anchor="middle">${o.xformat ? o.xformat(x) : x}</text>`;
  if (o.xlabel) out += `<text x="${(left + w - right) / 2}" y="${h - 3}" text-anchor="middle">${text(o.xlabel)}</text>`;
  series.forEach((s, i) => {
    let path = "", pen = "M";
    for (const [x, y] of s.points) {
      if (y === null) { pen = "M"; continue; }
      path += `${pen}${X(x).toFixed(1)} ${Y(y).toFixed(1)}`;
      pen = "L";
    }
    const band = s.band ? `<path class="band" fill="${s.colour}" d="M${s.band.map((b) => `${X(b[0])} ${Y(b[1])}`).join("L")}L${s.band.slice().reverse().map((b) => `${X(b[0])} ${Y(b[2])}`).join("L")}Z"/>` : "";
    out += `<g class="mark" data-i="${i}">${band}<path d="${path}" fill="none" stroke="${s.colour}" stroke-width="${s.strong ? 2.4 : 1.6}" stroke-dasharray="${s.dash || ""}" stroke-linejoin="round"/></g>`;
  });
  box.innerHTML = out + "</svg>" + (o.still ? "" : `<div class="readout">&nbsp;</div><ul class="legend">${series.map((s, i) => `<li data-i="${i}"><span class="swatch" style="background:${s.colour}"></span>${text(s.name)}</li>`).join("")}</ul>`);
  if (o.still) return;
  const svg = box.querySelector("svg"), readout = box.querySelector(".readout");
  const show = (i, said) => {
    svg.classList.toggle("dim", i !== null);
    svg.querySelectorAll(".mark").forEach((g) => g.classList.toggle("on", +g.dataset.i === i));
    readout.innerHTML = said || "&nbsp;";
  };
  svg.addEventListener("pointermove", (event) => {
    const seen = svg.getBoundingClientRect(), scale = w / seen.width;
    const px = (event.clientX - seen.left) * scale, py = (event.clientY - seen.top) * scale;
    let best = null;
    series.forEach((s, i) => s.points.forEach(([x, y], k) => {
      if (y === null) return;
      const far = Math.abs(X(x) - px) * 2 + Math.abs(Y(y) - py);
      if (!best || far < best.far) best = { far, i, k };
    }));
    if (best) show(best.i, `<b>${text(series[best.i].name)}</b>, ${o.said(series[best.i], best.k)}`);
  });
  svg.addEventListener("pointerleave", () => show(null));
  box.querySelectorAll(".legend li").forEach((li) => {
    li.addEventListener("pointerenter", () => show(+li.dataset.i));
    li.addEventListener("pointerleave", () => show(null));
  });
}

// rows: {name, colour, value, interval, said}; a dot and a whisker each.
function dots(box, rows, o) {
  if (!rows.length) return nothing(box);
  const w = width(box), line = 22, left = 16 + 6.1 * Math.max(...rows.map((r) => r.name.length)), right = 44, top = 4, h = top + rows.length * line + 24;
  const [x0, x1] = o.x, X = (x) => left + ((Math.min(Math.max(x, x0), x1) - x0) / (x1 - x0)) * (w - left - right);
  let out = `<svg viewBox="0 0 ${w} ${h}" width="${w}" height="${h}" role="img" aria-label="${text(o.label)}">`;
  for (const x of ticks(x0, x1, w < 420 ? 2 : 4))
    out += `<line class="grid" x1="${X(x)}" x2="${X(x)}" y1="${top}" y2="${h - 20}"/><text x="${X(x)}" y="${h - 6}" text-anchor="middle">${x}</text>`;
  rows.forEach((r, i) => {
    const y = top + (i + 0.5) * line;
    out += `<g class="mark" opacity="${r.faint ? 0.55 : 1}"><title>${text(r.said)}</title><rect x="0" y="${y - line / 2}" width="${w}" height="${line}" fill="transparent"/><text x="${left - 10}" y="${y + 4}" text-anchor="end" style="fill:var(--ink)">${text(r.name)}</text>`;
    if (r.interval) out += `<line x1="${X(r.interval[0])}" x2="${X(r.interval[1])}" y1="${y}" y2="${y}" stroke="${r.colour}" stroke-width="2"/>`;
    out += `<circle cx="${X(r.value)}" cy="${y}" r="4" fill="${r.colour}"/><text x="${w - right + 10}" y="${y + 4}">${two(r.value)}</text></g>`;
  });
  box.innerHTML = out + "</svg>";
}

function adaptation(box, rows, o) {
  const longest = Math.max(...rows.map((r) => r.scores.length)), trained = rows[0].trained;
  if (longest === 1) {
    const marks = rows.slice().sort((a, b) => b.value - a.value).map((r) => ({ name: r.method, colour: D.methods[r.method].colour, value: r.value, interval: r.interval, said: `${r.method} ${two(r.value)}, ${range(r.interval)}, ${seeds(r.n)}` }));
    return dots(box, marks, { x: [-0.1, 1.1], label: "score of each method" });
  }
  const series = rows.map((r) => ({
    name: r.method, colour: D.methods[r.method].colour, dash: dash(r.method), strong: r.method === o.strong, r,
    points: r.scores.map((s, i) => [i + 1, s]), band: r.band && r.band.map((b, i) => [i + 1, b[0], b[1]]),
  }));
  const ys = rows.flatMap((r) => [...r.scores, ...(r.band || []).flat()]);
  lines(box, series, {
    ...o, x: [1, longest], y: [Math.min(0, ...ys), Math.max(1, ...ys)], xticks: ticks(1, longest, longest > 8 ? 5 : longest).filter(Number.isInteger),
    shade: longest > trained ? trained + 0.5 : 0, xlabel: o.still ? "" : "episode" + (longest > trained ? " (shaded: longer than trained on)" : ""), label: "score by episode",
    said: (s, k) => `episode ${k + 1}: ${two(s.points[k][1])}${s.r.band ? ", " + range(s.r.band[k]) : ""}, ${seeds(s.r.n)}`,
  });
}

function learning(box, kind, rows, o) {
  const series = rows.map((r) => {
    const end = Math.max(...Object.values(r.curve).map((c) => c.update.at(-1))), c = r.curve[kind];
    return { name: r.method, colour: D.methods[r.method].colour, r, updates: c.update, points: c.update.map((u, i) => [u / end, c.loss[i]]) };
  });
  // Where losses span orders of magnitude, the first updates are cut off: the rest is what there is to see.
  const all = series.flatMap((s) => s.points.map((p) => p[1]).filter((y) => y !== null)).sort((a, b) => a - b);
  const high = all[Math.floor(all.length * 0.97)], low = all[0], room = (high - low) * 0.06 || 1;
  lines(box, series, {
    ...o, x: [0, 1], y: [low - room, high + room], xformat: (x) => `${Math.round(100 * x)}%`, label: `${kind} loss`,
    xlabel: o.still ? "" : "share of training", said: (s, k) => `update ${s.updates[k].toLocaleString("en")}: ${s.points[k][1]}, ${seeds(s.r.curve[kind].seeds)}`,
  });
}

// ---- the card of a number -----------------------------------------------------------------------------------------

const card = at("card");
let pinned = null;

function fill(r) {
  const minus = Object.entries(r.minus).map(([other, f]) => `<tr><td>vs ${text(other)}<td>${signed(f.value)}<td class="soft">${range(f.interval)}<td class="soft">${seeds(f.n)}</tr>`);
  card.innerHTML = `<button aria-label="close">\u2715</button><h3>${text(r.method)} <span class="soft">on ${text(r.task)}</span></h3>
    <table><tr><td>score<td><b>${two(r.value)}</b><td class="soft">${range(r.interval)}<td class="soft">${seeds(r.n)}</tr>
      <tr><td>first episode<td>${two(r.first.value)}<td class="soft">${range(r.first.interval)}</tr>
      <tr><td>regret<td>${two(r.regret.value)}<td class="soft">${range(r.regret.interval)}</tr>${minus.join("")}</table>
    <p class="soft">score by episode${r.trained > 1 ? ", beside the exact policies" : ""}</p><div class="a"></div>
    ${Object.keys(r.curve).map((kind, i) => `<p class="soft">${text(kind)} loss, over the share of training</p><div class="l${i}"></div>`).join("")}
    <p class="soft">${r.version ? text(r.version) + "; " : ""}${text(r.data || "no data")}; ${r.cpu === null ? "trained on a GPU" : r.cpu + " s of CPU a seed"}</p><p><code class="run">${text(r.command)}</code></p>`;
  const beside = D.rows.filter((x) => x.task === r.task && D.methods[x.method].kind === "exact" && !D.methods[x.method].deployment && x !== r);
  adaptation(card.querySelector(".a"), [...beside, r], { still: true, h: 120, strong: r.method });
  Object.keys(r.curve).forEach((kind, i) => learning(card.querySelector(`.l${i}`), kind, [r], { still: true, h: 90 }));
}

function open(cell, keep) {
  card.hidden = false;
  fill(where(cell.dataset.task, cell.dataset.method));
  card.classList.toggle("pinned", keep);
  const c = cell.getBoundingClientRect(), own = card.getBoundingClientRect(), gap = 8;
  const left = c.right + gap + own.width < innerWidth ? c.right + gap : Math.max(gap, c.left - gap - own.width);
  card.style.left = `${left}px`;
  card.style.top = `${Math.max(gap, Math.min(c.top, innerHeight - own.height - gap))}px`;
}

function shut() {
  if (pinned) pinned.classList.remove("pinned");
  pinned = null;
  card.hidden = true;
}

const cellOf = (event) => event.target.closest && event.target.closest("td.open");
document.addEventListener("pointerover", (event) => {
  const cell = cellOf(event);
  if (event.pointerType === "mouse" && cell && !pinned) open(cell, false);
});
document.addEventListener("pointerout", (event) => { if (cellOf(event) && !pinned) card.hidden = true; });
document.addEventListener("click", (event) => {
  const cell = cellOf(event);
  if (event.target.closest("#card") && !event.target.closest("#card button")) return;
  const again = cell && cell === pinned;
  shut();
  if (cell && !again) { pinned = cell; cell.classList.add("pinned"); open(cell, true); }
});
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape") shut();
  if (event.key === "Enter" && cellOf(event)) event.target.click();
});

// ---- tables -------------------------------------------------------------------------------------------------------

const form = at("filter");
const order = { matrix: { by: "", down: true }, all: { by: "task", down: false } };

function chosen() {
  const { task, tier, method, kind, measure } = Object.fromEntries(new FormData(form));
  const tasks = D.tasks.map((t) => t.name).filter((t) => (!task || t === task) && (!tier || tierOf[t] === tier));
  const methods = Object.keys(D.methods).filter((m) => (!method || m === method) && (!kind || D.methods[m].tier === kind));
  return { tasks, methods, tier, measure, rows: D.rows.filter((r) => tasks.includes(r.task) && methods.includes(r.method)) };
}

const heading = (table, key, label, cls = "", down = order[table].down) => {
  const sorted = order[table].by === key ? ` aria-sort="${down ? "descending" : "ascending"}"` : "";
  return `<th scope="col" class="${cls}"${sorted}><button data-table="${table}" data-key="${text(key)}">${label}</button></th>`;
};
const sorter = (value, down) => (a, b) => {
  const [x, y] = [value(a), value(b)];
  if (x === y) return 0;
  if (x === undefined || x === null) return 1;
  if (y === undefined || y === null) return -1;
  return (x < y ? -1 : 1) * (down ? -1 : 1);
};

function matrix({ tasks, methods, tier, measure }) {
  const over = D.over[tier].methods, { by } = order.matrix, down = order.matrix.down !== (measure === "regret"); // less is better
  const value = (m) => (by ? measured(where(by, m), measure)?.value : over[m] && iqm(over[m], measure)?.value);
  const share = (r) => (measure === "regret" ? 1 - r.regret.value / r.trained : measured(r, measure).value);
  const whole = (m) => over[m]?.tasks === D.over[tier].tasks.length;
  const listed = methods.filter((m) => tasks.some((t) => where(t, m))).sort(sorter(value, down));
  if (!by) listed.sort((a, b) => whole(b) - whole(a)); // what was run on some tasks alone is not to be compared
  const groups = [...new Set(tasks.map((t) => tierOf[t]))];
  const starts = new Set(groups.map((g) => tasks.find((t) => tierOf[t] === g)));
  const first = (t) => (starts.has(t) ? "first" : "");
  let out = `<thead><tr><th></th><th></th>${groups.map((g) => `<th colspan="${tasks.filter((t) => tierOf[t] === g).length}">tier ${g}</th>`).join("")}</tr>
    <tr><th scope="col">method <span class="tier">tier</span></th>${heading("matrix", "", "over tasks", "first", down)}${tasks.map((t) => heading("matrix", t, breakable(t), first(t), down)).join("")}</tr></thead><tbody>`;
  for (const m of listed) {
    const o = over[m];
    out += `<tr><th scope="row"><span class="name">${swatch(m)}<span>${breakable(m)}<span class="tier">${D.methods[m].tier}</span></span></span></th>`;
    out += o ? `<td class="first${whole(m) ? "" : " soft"}">${two(iqm(o, measure).value)}<small>${whole(m) ? range(iqm(o, measure).interval) : `${o.tasks} of ${D.over[tier].tasks.length} tasks`}</small></td>` : `<td class="first"></td>`;
    for (const t of tasks) {
      const r = where(t, m), f = measured(r, measure);
      out += r ? `<td class="open ${first(t)}" tabindex="0" data-task="${text(t)}" data-method="${text(m)}" style="background:color-mix(in srgb, var(--accent) ${Math.round(38 * Math.min(Math.max(share(r), 0), 1))}%, transparent)">${two(f.value)}${older(r)}<small>${f.interval ? range(f.interval) : "one seed"}</small></td>` : `<td class="${first(t)}"></td>`;
    }
    out += "</tr>";
  }
  at("what").textContent = MEASURES[measure];
  at("matrix").innerHTML = out + "</tbody>";
}

const older = (r) => (r.version.includes("now") ? "*" : "");

const COLUMNS = [
  ["task", "task", (r) => r.task, (r) => text(r.task), "left"],
  ["method", "method", (r) => r.method, (r) => swatch(r.method) + text(r.method), "left"],
  ["tier", "tier", (r) => D.methods[r.method].tier, (r) => text(D.methods[r.method].tier)],
  ["value", "score", (r) => r.value, (r) => two(r.value), "open"],
  ["low", "interval", (r) => r.interval && r.interval[0], (r) => range(r.interval) + (r.interval ? ` (${r.held}%)` : "")],
  ["first", "first episode", (r) => r.first.value, (r) => two(r.first.value)],
  ["first low", "interval", (r) => r.first.interval && r.first.interval[0], (r) => range(r.first.interval)],
  ["regret", "regret", (r) => r.regret.value, (r) => two(r.regret.value)],
  ["regret low", "interval", (r) => r.regret.interval && r.regret.interval[0], (r) => range(r.regret.interval)],
  ["n", "seeds", (r) => r.n, (r) => r.n],
  ["version", "version", (r) => r.version, (r) => text(r.version), "left"],
  ...D.compared.map((other) => [`vs ${other}`, `vs ${other}`, (r) => r.minus[other]?.value, (r) => (r.minus[other] ? `${signed(r.minus[other].value)} <span class="soft">(${range(r.minus[other].interval)}${r.minus[other].interval && r.minus[other].n < r.n ? `, ${seeds(r.minus[other].n)}` : ""})</span>` : "")]),
  ["r2", "theta R2", (r) => r.r2.at(-1), (r) => (r.r2.length ? two(r.r2.at(-1)) : "")],
  ["return", "return", (r) => r.return, (r) => r.return.toFixed(1)],
  ["objective", "Eq. (1)", (r) => r.objective, (r) => r.objective.toLocaleString("en")],
  ["data", "data, a seed", (r) => r.data, (r) => text(r.data), "left"],
  ["cpu", "CPU s", (r) => r.cpu, (r) => r.cpu === null ? "by GPU" : r.cpu.toFixed(0)],
  ["command", "command", (r) => r.command, (r) => `<code class="run">${text(r.command)}</code>`, "left"],
];

function all({ rows }) {
  const { by, down } = order.all, get = COLUMNS.find((c) => c[0] === by)[2];
  const listed = rows.slice().sort((a, b) => b.value - a.value).sort(sorter(get, down));
  const head = COLUMNS.map(([key, label, , , cls]) => heading("all", key, text(label), cls === "left" ? "left" : "")).join("");
  const body = listed.map((r) => `<tr>${COLUMNS.map(([, , , cell, cls]) => `<td class="${cls || ""}"${cls === "open" ? ` tabindex="0" data-task="${text(r.task)}" data-method="${text(r.method)}"` : ""}>${cell(r)}</td>`).join("")}</tr>`);
  at("all").firstElementChild.innerHTML = `<thead><tr>${head}</tr></thead><tbody>${body.join("")}</tbody>`;
}

// ---- over tasks ---------------------------------------------------------------------------------------------------

function overTasks({ methods, tier, measure }) {
  const { tasks, methods: over } = D.over[tier], whole = (f) => f.tasks === tasks.length;
  const names = Object.keys(D.methods).filter((m) => methods.includes(m) && over[m] && D.methods[m].kind !== "reference");
  const entry = (m, f, k) => ({ name: m + (k < tasks.length ? ` (${k})` : ""), colour: D.methods[m].colour, value: f.value, interval: f.interval, faint: k < tasks.length, said: `${m} ${two(f.value)}, ${range(f.interval)}, ${f.n} runs on ${k} of ${tasks.length} tasks` });
  const mixed = names.filter((m) => D.rows.some((r) => r.method === m && tasks.includes(r.task) && older(r)));
  const few = names.filter((m) => !whole(over[m])).length, runs = extent(names.map((m) => over[m].iqm.n));
  at("over-what").textContent = `${tasks.length} task${tasks.length > 1 ? "s" : ""}${tier ? ` of tier ${tier}` : ""}` + (names.length ? "" : ".");
  if (names.length) at("over-what").textContent += `, ${runs[0] === runs[1] ? runs[0] : runs.join(" to ")} runs a method, a run being a seed of a task.` +
    (few ? " A method that was run on some of the tasks is faint, with their number in brackets, and not to be compared with the others." : "") +
    (mixed.length ? ` Some records of ${mixed.join(", ")} are of older versions.` : "");
  const best = names.slice().sort((a, b) => whole(over[b]) - whole(over[a]) || over[b].iqm.value - over[a].iqm.value);
  const means = best.map((m) => entry(m, iqm(over[m], measure), over[m].tasks)), high = Math.max(1, ...means.map((r) => r.value));
  at("iqm").previousElementSibling.textContent = `Interquartile mean: ${MEASURES[measure].toLowerCase()}`;
  dots(at("iqm"), means, { x: [-0.05 * high, 1.05 * high], label: "interquartile mean of each method" });
  dots(at("improvement"), best.filter((m) => over[m].improvement).map((m) => entry(m, over[m].improvement, over[m].improvement.tasks)), { x: [0, 1], label: "probability of improvement over each method" });
  const series = best.map((m) => ({
    name: m, colour: D.methods[m].colour, dash: dash(m), f: over[m], points: D.thresholds.map((t, i) => [t, over[m].profile.value[i]]),
    band: over[m].profile.interval && D.thresholds.map((t, i) => [t, over[m].profile.interval[0][i], over[m].profile.interval[1][i]]),
  }));
  lines(at("profile"), series, { x: extent(D.thresholds), y: [0, 1], h: 280, xlabel: "score", label: "performance profiles", said: (s, k) => `above ${two(s.points[k][0])}: ${Math.round(100 * s.points[k][1])}% of ${s.f.profile.n} runs on ${s.f.tasks} tasks` });
}

// ---- tasks --------------------------------------------------------------------------------------------------------

function draw(details) {
  const rows = D.rows.filter((r) => r.task === details.dataset.task);
  if (!details.open || details.dataset.drawn) return;
  details.dataset.drawn = "yes";
  const link = details.querySelector("a.film"), film = new Image();
  film.onload = () => { link.firstElementChild.src = film.src; }; // a copy of the page alone keeps the still
  if (link) film.src = link.href;
  adaptation(details.querySelector(".adaptation"), rows, { h: 290 });
  const box = details.querySelector(".learning");
  const trained = rows.filter((r) => !D.methods[r.method].deployment); // the same agent, deployed otherwise
  const kinds = [...new Set(trained.flatMap((r) => Object.keys(r.curve)))];
  box.innerHTML = kinds.map((kind) => `<figure><h3>${text(kind[0].toUpperCase() + kind.slice(1))} loss</h3><div></div></figure>`).join("");
  kinds.forEach((kind, i) => learning(box.children[i].lastElementChild, kind, trained.filter((r) => r.curve[kind]), { h: 200 }));
}

const parts = [...document.querySelectorAll("details[data-task]")];
parts.forEach((d) => d.addEventListener("toggle", () => draw(d)));

function show() {
  const now = chosen();
  shut();
  matrix(now);
  all(now);
  overTasks(now);
  parts.forEach((d) => { d.hidden = !now.tasks.includes(d.dataset.task); });
  at("count").textContent = `${now.rows.length} of ${D.rows.length} results`;
}

form.addEventListener("change", () => {
  const left = parts.filter((d) => chosen().tasks.includes(d.dataset.task));
  if (left.length === 1) left[0].open = true;
  show();
});
document.addEventListener("click", (event) => {
  const button = event.target.closest("th button");
  if (!button) return;
  const o = order[button.dataset.table], key = button.dataset.key;
  const words = button.dataset.table === "all" && ["task", "method", "tier", "data", "command"].includes(key);
  Object.assign(o, { by: key, down: o.by === key ? !o.down : !words });
  show();
});
show();
parts.forEach(draw);
