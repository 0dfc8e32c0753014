"use strict";
// Everything that is shown goes through textContent or a property; nothing here makes markup of data.
const data = JSON.parse(document.getElementById("data").textContent);
const key = `audit-labels:${data.page}`;
const state = { clip: 0, row: 0, frame: 0, playing: 0, all: false, annotator: "", labels: {} };
const ui = {};

function el(tag, options = {}, ...children) {
  const { className, text, ...rest } = options;
  const node = document.createElement(tag);
  if (className) node.className = className;
  if (text !== undefined) node.textContent = text;
  for (const [name, value] of Object.entries(rest)) node[name] = value;
  node.append(...children.filter((child) => child !== null && child !== undefined));
  return node;
}

const clip = () => data.clips[state.clip];
const labelsOf = (one) => state.labels[one.evaluation]?.rows ?? {};
// Rows that the judge decided, or that are labelled. Its answer shows once a row is labelled, the rest once all are.
const rowsOf = (one) => data.rubrics[one.rubric].rows.filter(({ name }) =>
  state.all || labelsOf(one)[name] || (one.rows[name]?.value ?? null) !== null);
const rows = () => rowsOf(clip());
const row = () => rows()[state.row];
const finished = () => rows().every(({ name }) => labelsOf(clip())[name]);
const number = (value, digits = 2) => (value === null || value === undefined ? "-" : value.toFixed(digits));
const imageUrl = (name) => `${data.media}/${name}`;
const said = (entry) => data.clips[state.clip].rows[entry.name] ?? { value: null, votes: [], frames: [], why: "" };

const joined = (...parts) => parts.filter(Boolean).join(" · ");
const keyTable = (pairs) => el("table", {}, ...pairs.map(([name, text]) =>
  el("tr", {}, el("td", {}, el("kbd", { text: name })), el("td", { text }))));

function word(entry, value) {
  if (value === null || value === undefined) return "no answer";
  if (entry.stage === "PLAN") return `L${value}`;
  if (entry.stage === "HACK") return value ? "absent" : "present";
  return value ? "pass" : "fail";
}

function labelWord(entry, label) {
  if (!label) return "";
  const level = label.level === null ? "" : ` (level ${label.level})`;
  const why = label.explanation === null ? "" : label.explanation ? ", reason right" : ", reason wrong";
  if (label.answer === "unsure") return `unsure${why}`;
  if (entry.stage === "PLAN") return `L${label.level}${why}`;
  return word(entry, label.answer === "pass") + level + why;
}

// --- labels -----------------------------------------------------------------------------------------------------
function restore() {
  try {
    const kept = JSON.parse(localStorage.getItem(key) ?? "null");
    if (kept) Object.assign(state, { annotator: kept.annotator, labels: kept.labels });
  } catch (error) {
    warn(`Labels kept by this browser cannot be read: ${error.message}`);
  }
}

function keep() {
  try {
    localStorage.setItem(key, JSON.stringify({ annotator: state.annotator, labels: state.labels }));
  } catch (error) {
    warn(`This browser does not keep labels (${error.message}). Export before you close the page.`);
  }
}

function warn(text) { ui.banner.textContent = text; ui.banner.hidden = !text; }

function setLabel(name, change) {
  const one = clip();
  const held = (state.labels[one.evaluation] ??= { audit_id: one.audit_id, rows: {} });
  const before = held.rows[name] ?? { answer: "unsure", level: null, explanation: null };
  held.rows[name] = { ...before, ...change };
  changed();
}

function clearLabel() {
  const held = state.labels[clip().evaluation];
  if (!held) return;
  delete held.rows[row().name];
  if (!Object.keys(held.rows).length) delete state.labels[clip().evaluation];
  changed();
}

function changed() {
  keep();
  warn("");
  drawRows();
  drawItem(state.clip);
  drawProgress();
}

function answer(change) {
  setLabel(row().name, change);
  setRow(state.row + 1);
}

function say(passes) {
  if (row().stage === "PLAN") return warn(`Press the level 0 to ${row().levels.length - 1} that you see.`);
  answer({ answer: passes ? "pass" : "fail", level: null });
}

function setLevel(level) {
  const entry = row();
  const count = entry.levels.length;
  if (level >= count) return warn(count ? `${entry.name} has levels 0 to ${count - 1}.` : "Press p or f.");
  answer({ answer: level >= (entry.stage === "PLAN" ? 2 : 3) ? "pass" : "fail", level });
}

function explain() {
  const mine = labelsOf(clip());
  const { name } = rows()[mine[row().name] ? state.row : Math.max(0, state.row - 1)];
  if (!mine[name]) return warn("Label the row first, then say whether the judge's reason is right.");
  setLabel(name, { explanation: mine[name].explanation === null ? true : mine[name].explanation ? false : null });
}

function labelFile() {
  const labels = data.clips.filter((one) => state.labels[one.evaluation]).map(({ evaluation, sha256, audit_id }) => (
    { evaluation, sha256, audit_id, rows: state.labels[evaluation].rows }
  ));
  const exported = new Date().toISOString();
  return { format: data.format, head: data.head, annotator: state.annotator, exported, labels };
}

function save() {
  if (!state.annotator) {
    ui.annotator.focus();
    return warn("Type your name first: a report tells two people apart.");
  }
  const file = new Blob([JSON.stringify(labelFile(), null, 1)], { type: "application/json" });
  const download = `labels-${state.annotator.replace(/\W+/g, "-")}.json`;
  const link = el("a", { href: URL.createObjectURL(file), download });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// --- page -------------------------------------------------------------------------------------------------------
function drawItem(index) {
  const one = data.clips[index];
  const done = Object.keys(labelsOf(one)).length;
  ui.items[index].replaceChildren(
    el("div", { text: one.clip_id }),
    el("div", { className: "faint",
      text: joined(`${done}/${rowsOf(one).length} labelled`, one.second && "second annotator") }),
  );
  ui.items[index].classList.toggle("now", index === state.clip);
}

function drawProgress() {
  const labelled = data.clips.filter((one) => Object.keys(labelsOf(one)).length).length;
  ui.progress.textContent = `${labelled} of ${data.clips.length} clips labelled`;
}

function show(index) {
  if (index < 0 || index >= data.clips.length) return;
  const before = state.clip;
  state.clip = index;
  state.frame = 0;
  stop();
  drawItem(before);
  drawItem(index);
  ui.items[index].scrollIntoView({ block: "nearest" });
  drawClip();
}

function drawClip() {
  const one = clip();
  ui.player = el("img", { alt: "current frame", width: 224 });
  ui.playerText = el("figcaption");
  ui.frames = one.frames.map((name, index) => el("figure", { onclick: () => setFrame(index) },
    el("img", { loading: "lazy", decoding: "async", width: 96, alt: `frame ${index}`, src: imageUrl(name) }),
    el("figcaption", { text: `${index} · ${number(index / one.fps)} s` })));
  const still = (name, text) => (name ? el("figure", {},
    el("img", { loading: "lazy", width: 96, alt: text, src: imageUrl(name) }), el("figcaption", { text })) : null);
  ui.table = el("div", { className: "rows" });
  ui.told = el("div");
  ui.main.replaceChildren(...[
    el("h2", { className: "text", text: one.clip_id }),
    el("p", { className: "text", text: one.instruction }),
    el("p", { className: "faint text", text: joined(one.task, one.robot, one.source, `round ${one.round}`,
      `judge ${one.judge.id}`, `rubric ${one.rubric}`) }),
    el("div", { className: "pictures" },
      el("figure", {}, ui.player, ui.playerText),
      el("div", {}, still(one.reference, "reference"), still(one.goal, "goal")),
      el("div", { className: "strip" }, ...ui.frames)),
    one.frames.length ? null : el("p", { className: "bad", text: "no pictures: the clip is malformed" }),
    ui.table, ui.told,
  ].filter(Boolean));
  ui.main.scrollTop = 0;
  drawRows();
  setFrame(0);
}

function drawRows() {
  const shown = rows();
  ui.rows = shown.map((entry, index) => el("div", { className: "row", onclick: () => setRow(index) }));
  ui.table.replaceChildren();
  shown.forEach((entry, index) => {
    if (entry.stage !== shown[index - 1]?.stage) ui.table.append(stageHead(entry.stage));
    ui.table.append(ui.rows[index]);
    drawRow(entry, index);
  });
  ui.told.replaceChildren(...(finished() ? details(clip()) : []));
  setRow(Math.min(state.row, Math.max(0, shown.length - 1)));
}

function stageHead(name) {
  const one = clip();
  const found = one.stages.find((stage) => stage.stage === name);
  const threshold = data.rubrics[one.rubric].thresholds[name];
  const titles = { PLAN: "Planning", HACK: "Hacking patterns", ALL: "The whole clip" };
  const head = el("div", { className: "stage", text: `${titles[name] ?? name} ` });
  if (!found || !finished()) return head;
  const numbers = `S ${number(found.s)} against ${number(threshold)}, weight ${number(one.weights[name])}`;
  const text = found.status === "OK" ? joined(numbers, found.veto && `vetoed by ${found.veto}`)
    : found.status.toLowerCase();
  head.append(el("span", { className: "faint", text: `${text} ` }));
  if (found.status === "OK") {
    const result = found.passed ? "passed" : "failed";
    head.append(el("span", { className: found.passed ? "good" : "bad", text: result }));
  }
  return head;
}

function drawRow(entry, index) {
  const judge = said(entry);
  const mine = labelsOf(clip())[entry.name];
  const kind = !mine || judge.value === null ? "faint" : entry.stage === "PLAN" ? "" : judge.value ? "good" : "bad";
  const numbers = judge.p_fail === undefined ? ""
    : `s ${number(judge.s)}, p(fail) ${number(judge.p_fail)}, margin ${number(judge.margin)}`;
  const titles = ["vote", "levels 0 ..", "mass", "frames", "reason"];
  const votes = el("table", {}, el("tr", {}, ...titles.map((text) => el("th", { text }))));
  for (const vote of judge.votes) {
    const cells = [`${vote.index} ${vote.kind} ${vote.polarity}`, vote.levels.map((p) => number(p)).join(" "),
      number(vote.mass), vote.frames.join(" "), joined(vote.status !== "OK" && vote.status, vote.why, vote.reason)];
    votes.append(el("tr", {}, ...cells.map((text) => el("td", { className: "why", text }))));
  }
  const by = el("p", { className: "faint", text: joined(judge.decided_by, numbers, judge.reason) });
  const told = mine ? [by, judge.votes.length ? votes : ""] : [];
  ui.rows[index].replaceChildren(
    el("div", { text: entry.name }),
    el("div", { className: "mine", text: labelWord(entry, mine) || "-" }),
    el("div", { className: kind, text: mine ? word(entry, judge.value) : "" }),
    el("div", { className: "why", text: mine ? judge.why || judge.reason || "" : "" }),
    el("div", { className: "more" },
      el("p", { className: "faint", text: entry.question }),
      keyTable(entry.levels.map((text, level) => [String(level), text])), ...told),
  );
}

function details(one) {
  const reward = one.reward === null ? `${one.status}: ${one.reason}`
    : `reward ${number(one.reward, 3)}${one.reason ? ` (${one.reason})` : ""}`;
  const drawn = one.stratum ? `, drawn as ${one.stratum}` : "";
  const parts = [el("p", { className: one.reward === null ? "bad" : "", text: `${reward}${drawn}` })];
  one.reflections.forEach((second) => {
    parts.push(el("h3", { text: `Second look: ${second.triggers.join("; ")}` }));
    for (const change of second.changed) {
      const moved = `${change.component} ${number(change.before)} → ${number(change.after)}`;
      const taken = `${change.accepted ? "" : "not "}accepted, frames ${change.frames.join(" ")}`;
      parts.push(el("p", { className: "why", text: `${moved}, ${taken}: ${change.reason}` }));
    }
  });
  const short = (value) => (value === null ? "-" : +value.toPrecision(4));
  const list = (values) => Object.entries(values).map(([name, value]) => `${name} ${short(value)}`).join(", ");
  const signals = list(one.evidence);
  if (signals) parts.push(el("p", { className: "faint", text: `evidence: ${signals}` }));
  parts.push(el("p", { className: "faint", text: `cost: ${one.reads} reads, ${list(one.cost)}` }));
  const names = joined(`clip ${one.sha256}`, `audit id ${one.audit_id}`, `line ${one.evaluation}`);
  parts.push(el("p", { className: "faint text", text: names }));
  return parts;
}

function setRow(index) {
  if (index < 0 || index >= ui.rows.length) return;
  ui.rows[state.row]?.classList.remove("now");
  state.row = index;
  ui.rows[index].classList.add("now");
  ui.rows[index].scrollIntoView({ block: "nearest" });
  const cited = new Set(labelsOf(clip())[row().name] ? said(row()).frames : []);
  ui.frames.forEach((figure, frame) => figure.classList.toggle("cited", cited.has(frame)));
}

function setFrame(index) {
  const frames = clip().frames;
  if (!frames.length) return;
  ui.frames[state.frame]?.classList.remove("now");
  state.frame = (index + frames.length) % frames.length;
  ui.player.src = imageUrl(frames[state.frame]);
  const time = number(state.frame / clip().fps);
  ui.playerText.textContent = `frame ${state.frame} of ${frames.length}, ${time} s`;
  ui.frames[state.frame].classList.add("now");
}

function step(by) { stop(); setFrame(state.frame + by); }
function stop() { clearInterval(state.playing); state.playing = 0; }
function play() {
  if (state.playing) return stop();
  state.playing = setInterval(() => setFrame(state.frame + 1), 1000 / Math.max(1, clip().fps));
}

function nextOpen() {
  for (let step = 1; step <= data.clips.length; step += 1) {
    const index = (state.clip + step) % data.clips.length;
    if (!Object.keys(labelsOf(data.clips[index])).length) return show(index);
  }
  warn("Every clip has a label.");
}

function showAll() {
  state.all = !state.all;
  drawRows();
}

const labelling = (act) => () => (row() ? act() : warn("The judge decided no row of this clip; r shows all rows."));
const KEYS = {
  p: [labelling(() => say(true)), "pass; of a hacking pattern: absent"],
  f: [labelling(() => say(false)), "fail; of a hacking pattern: present"],
  u: [labelling(() => answer({ answer: "unsure", level: null })), "unsure"],
  e: [labelling(explain), "the judge's reason is right, wrong, not judged: of this row, or the one just labelled"],
  x: [labelling(clearLabel), "clear the label"],
  ArrowDown: [() => setRow(state.row + 1), "next row"], ArrowUp: [() => setRow(state.row - 1), "row before"],
  ArrowRight: [() => show(state.clip + 1), "next clip"], ArrowLeft: [() => show(state.clip - 1), "clip before"],
  n: [nextOpen, "next clip without labels"], " ": [play, "play or stop"],
  ",": [() => step(-1), "frame before"], ".": [() => step(1), "next frame"],
  r: [showAll, "also the rows that the judge did not decide, or only those it did"],
  s: [save, "export the labels as a file"], "?": [() => ui.help.showModal(), "this help"],
};
for (let level = 0; level <= 4; level += 1) {
  KEYS[level] = [labelling(() => setLevel(level)), `label with level ${level}`];
}

function onKey(event) {
  const typing = event.target instanceof HTMLInputElement;
  if (typing && event.key === "Enter") event.target.blur();
  if (typing || ui.help.open || event.ctrlKey || event.metaKey || event.altKey || !KEYS[event.key]) return;
  event.preventDefault();
  KEYS[event.key][0]();
}

function build() {
  ui.banner = el("div", { className: "banner", hidden: true, role: "alert" });
  restore();
  const rename = (event) => { state.annotator = event.target.value.trim(); keep(); };
  ui.annotator = el("input", { value: state.annotator, placeholder: "your name", size: 14, oninput: rename });
  ui.progress = el("span", { className: "faint" });
  const pressed = (act) => (event) => { event.currentTarget.blur(); act(); };  // keys are the page's, not the button's
  const button = (text, act) => el("button", { type: "button", text, onclick: pressed(act) });
  ui.items = data.clips.map((one, index) => button("", () => show(index)));
  ui.main = el("main");
  const keys = Object.entries(KEYS).map(([name, [, text]]) => [name === " " ? "space" : name, text]);
  ui.help = el("dialog", {}, el("h3", { text: "Keys" }), keyTable(keys), button("close", () => ui.help.close()));
  document.body.append(
    el("header", {}, el("h1", { text: document.title }), ui.progress, ui.banner, el("span", { className: "grow" }),
      ui.annotator,
      button("keys", () => ui.help.showModal()), button("export labels", save)),
    el("nav", {}, ...ui.items), ui.main, ui.help,
  );
  if (!data.clips.length) { ui.main.textContent = "No clips."; return; }
  data.clips.forEach((one, index) => drawItem(index));
  drawProgress();
  show(0);
  document.addEventListener("keydown", onKey);
}

build();
