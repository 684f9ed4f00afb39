// The page: an overview of all units, and one unit with its parameters, predictions and innovations.
import { Charts } from "./charts.js";
import { Actions } from "./actions.js";
import { fromFile } from "./record.js";

const at = (id) => document.getElementById(id);
export const make = (tag, text, parent, kind) => {
  const one = document.createElement(tag);
  if (text !== undefined && text !== "") one.textContent = text;
  if (kind) one.className = kind;
  parent?.append(one);
  return one;
};
export const ask = async (path, body) => {
  const options = body === undefined ? {} :
    { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  const answer = await fetch(path, options).catch(() => {
    throw new Error("The service does not answer; the page tries again every few seconds.");
  });
  if (answer.status === 401) location.href = "/login";
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.error ?? `status ${answer.status}`);
  return content;
};
const short = (v) => (v === null || v === undefined ? "–" : Number.isInteger(v) ? v.toLocaleString() : Math.abs(v) >= 1e5 || (v && Math.abs(v) < 1e-3)
  ? v.toExponential(2) : v.toPrecision(4));

const state = { unit: null, range: "live", socket: null, samples: null, about: null, user: null, timer: 0 };
const charts = new Charts(at("charts"));
const actions = new Actions(() => refresh());

// ---------------------------------------------------------------- light and dark
const dark = matchMedia("(prefers-color-scheme: dark)");
const paint = () => {
  document.documentElement.dataset.theme = localStorage.theme ?? (dark.matches ? "dark" : "light");
  charts.repaint();
};
const turn = () => {
  localStorage.theme = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  paint();
};
dark.addEventListener("change", paint);
at("theme").addEventListener("click", turn);

// ---------------------------------------------------------------- connection
let pause = 500;
const connect = () => {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
  state.socket = socket;
  socket.addEventListener("open", () => { pause = 500; look(); });
  socket.addEventListener("message", (event) => receive(JSON.parse(event.data)));
  socket.addEventListener("close", (event) => {
    if (event.code === 4401) { location.href = "/login"; return; }
    link("reconnecting", "bad");
    at("numbers").textContent = "the service does not answer";
    setTimeout(connect, pause);
    pause = Math.min(2 * pause, 5000);
  });
};
const link = (text, kind) => { at("link").textContent = text; at("link").className = `pill ${kind}`; };
const look = () => {
  if (state.socket?.readyState !== WebSocket.OPEN) return;
  state.socket.send(JSON.stringify(state.unit ? { view: "unit", unit: state.unit } : { view: "fleet" }));
};

const rate = { at: 0, samples: 0, value: null };
const receive = (message) => {
  const { status } = message;
  link(status.alive ? "live" : "engine away", status.alive ? "good" : "bad");
  const told = [status.problem, ...(status.reasons ?? []).slice(0, 5)].filter(Boolean);
  at("problem").hidden = !told.length;
  at("problem").textContent = told.join("; ");
  const now = performance.now();
  if (now - rate.at > 1500) {
    if (rate.at && status.samples >= rate.samples) rate.value = (status.samples - rate.samples) / (now - rate.at) * 1e3;
    rate.at = now; rate.samples = status.samples;
  }
  const speed = rate.value === null ? "" : `${Math.round(rate.value).toLocaleString()} samples/s, `;
  at("numbers").textContent = `${speed}${(status.units ?? 0).toLocaleString()} units`;
  if (message.view === "fleet" && !state.unit) fleet(message.units, status.units);
  if (message.view === "unit" && message.unit === state.unit) unit(message);
};

// ---------------------------------------------------------------- overview
let searched = null;
const fleet = (units, count) => {
  const shown = searched ?? units;
  const body = at("units").tBodies[0];
  const most = Math.max(5, ...shown.map((one) => one.drift));
  while (body.rows.length < shown.length) row(body);
  while (body.rows.length > shown.length) body.deleteRow(-1);
  shown.forEach((one, k) => fill(body.rows[k], one, most));
  at("shown").textContent = shown.length < count ? `${shown.length} of ${count.toLocaleString()}` : "";
};
const row = (body) => {
  const tr = body.insertRow();
  tr.tabIndex = 0;
  make("td", "", tr);
  make("span", "", make("td", "", tr), "pill");
  const meter = make("div", "", make("td", "", tr), "meter");
  make("i", "", meter); make("span", "", meter);
  make("td", "", tr, "number"); make("td", "", tr, "number wide"); make("td", "", tr, "number");
  tr.addEventListener("click", () => open(tr.dataset.unit));
};
const ago = (age) => {
  if (age === null || age < 2) return age === null ? "–" : "now";
  const [unit, size] = age < 120 ? ["s", 1] : age < 7200 ? ["min", 60] : age < 172800 ? ["h", 3600] : ["d", 86400];
  return `${Math.round(age / size)} ${unit} ago`;
};
const set = (node, text) => { if (node.textContent !== text) node.textContent = text; };
const fill = (tr, one, most) => {
  tr.dataset.unit = one.unit;
  tr.classList.toggle("alarm", one.alarm);
  const cells = tr.cells;
  set(cells[0], one.unit);
  const bad = one.trouble.length ? one.trouble.join(", ") : one.alarm ? "alarm" : "";
  set(cells[1].firstChild, bad || (one.silent ? "silent" : "normal"));
  cells[1].firstChild.className = `pill ${bad ? "bad" : one.silent ? "" : "good"}`;
  const [bar, text] = cells[2].firstChild.children;
  bar.style.width = `${Math.round(85 * Math.min(1, one.drift / most))}%`;
  set(text, one.drift.toFixed(1));
  set(cells[3], short(one.y)); set(cells[4], short(one.y_hat));
  set(cells[5], ago(one.age));
};
at("search").addEventListener("input", async (event) => {
  const text = event.target.value.trim();
  searched = text ? (await ask(`/api/units?search=${encodeURIComponent(text)}`)).units : null;
});

// ---------------------------------------------------------------- one unit
const RANGES = { live: 0, "1 h": 3600, "1 d": 86400, all: Infinity };
const open = (name) => { location.hash = `#/unit/${encodeURIComponent(name)}`; };
const route = async () => {
  const match = location.hash.match(/^#\/unit\/(.+)$/);
  state.unit = match ? decodeURIComponent(match[1]) : null;
  at("fleet").hidden = Boolean(state.unit);
  at("unit").hidden = !state.unit;
  document.title = state.unit ? `${state.unit} · driftfit` : "driftfit";
  clearInterval(state.timer);
  charts.clear();
  if (state.unit) {
    state.range = "live"; state.about = null;
    at("name").textContent = state.unit;
    buttons();
    await refresh();
    state.timer = setInterval(refresh, 3000);
  }
  look();
};
const buttons = () => {
  at("ranges").replaceChildren();
  for (const name of Object.keys(RANGES)) {
    const one = make("button", name, at("ranges"));
    one.setAttribute("aria-pressed", String(name === state.range));
    one.addEventListener("click", () => {
      state.range = name; charts.clear(); buttons(); look(); refresh();
    });
  }
};
const refresh = async () => {
  const name = state.unit;
  if (!name) return;
  try {
    const [about, happened] = await Promise.all([
      ask(`/api/units/${encodeURIComponent(name)}`), ask(`/api/events?unit=${encodeURIComponent(name)}&limit=50`)]);
    if (state.unit !== name) return;
    state.about = about;
    described(about); events(happened.events);
    actions.show(about, state.user);
    if (state.range !== "live") await past(name);
  } catch (error) {
    at("model").textContent = error.message;
    if (!state.about) { at("badges").replaceChildren(); events([]); }
  }
};
const past = async (name) => {
  const span = RANGES[state.range];
  const now = state.about.now.time ?? 0;
  const from = Number.isFinite(span) ? `&from=${now - span}` : "";
  const found = await ask(`/api/history?unit=${encodeURIComponent(name)}&points=800${from}`);
  if (state.unit === name && state.range !== "live") charts.past(found, state.about);
};
const span = () => {
  const last = state.about?.now?.time;
  const length = state.range === "live" ? 120 : RANGES[state.range];
  return last && Number.isFinite(length) ? `&from=${last - length}` : "";
};
const described = ({ about, now, state: it }) => {
  const badges = at("badges");
  badges.replaceChildren();
  if (it.failure) make("span", `failed: ${it.failure}`, badges, "pill bad");
  if (now.alarm) make("span", "alarm", badges, "pill bad");
  if (it.acknowledged === false) make("span", "not acknowledged", badges, "pill bad");
  if (it.held) make("span", "held", badges, "pill");
  if (it.unarmed === null) make("span", "finding limits", badges, "pill");
  for (const [kind, why] of Object.entries(it.unarmed ?? {})) make("span", `alarm ${kind} is not armed: ${why}`, badges, "pill bad");
  const counts = Object.entries(it.counts ?? {}).map(([what, n]) => `${n.toLocaleString()} ${what}`).join(", ");
  at("model").textContent = `${about.model}, ${about.tracker}, ${about.gate ? "with" : "without"} a gate. ${counts}.`;
  for (const kind of ["csv", "arrow"]) {
    at(kind).href = `/api/export?unit=${encodeURIComponent(state.unit)}&format=${kind}${span()}`;
  }
  const bank = it.hypotheses;
  at("bank").hidden = !bank;
  if (bank) {
    const body = at("bank").querySelector("tbody");
    body.replaceChildren();
    for (const [name, probability] of Object.entries(bank)) {
      const tr = body.insertRow();
      make("td", name, tr);
      const meter = make("div", "", make("td", "", tr, "drift"), "meter");
      make("i", "", meter).style.width = `${Math.round(85 * probability)}%`;
      make("span", probability.toFixed(3), meter);
    }
  }
};
const unit = (message) => {
  if (message.missing) { at("model").textContent = "There is no such unit."; return; }
  if (state.range === "live" && message.columns.length && state.about) charts.live(message.columns, state.about);
};
const plain = (v) => (typeof v === "number" ? short(v) : Array.isArray(v) ? v.map(plain).join(", ")
  : v !== null && typeof v === "object" ? Object.entries(v).map(([k, one]) => `${k} ${plain(one)}`).join(", ") : v);
const events = (found) => {
  const body = at("events").tBodies[0];
  body.replaceChildren();
  for (const one of found) {
    const tr = body.insertRow();
    const { who, why, ...rest } = one.detail;
    make("td", new Date(one.at * 1000).toLocaleString(), tr);
    make("span", rest.do && one.kind === "action" ? rest.do : one.kind, make("td", "", tr),
      `pill ${["alarm", "failed"].includes(one.kind) ? "bad" : ""}`);
    make("td", who ?? "", tr);
    delete rest.do; delete rest.time;
    const text = one.kind === "alarm"
      ? [`${rest.kind}: ${rest.cause} is ${short(rest.statistic)}, limit ${short(rest.limit)}`]
      : Object.entries(rest).filter(([, v]) => v !== null && String(v) !== "").map(([k, v]) => `${k} ${plain(v)}`);
    make("td", [why, ...text].filter(Boolean).join(", "), tr);
  }
  if (!found.length) make("td", "None yet.", body.insertRow(), "quiet").colSpan = 4;
};

// ---------------------------------------------------------------- keyboard
addEventListener("keydown", (event) => {
  const typing = /INPUT|SELECT|TEXTAREA/.test(event.target.tagName);
  if (event.key === "Escape" && !at("ask").open) {
    if (typing) event.target.blur(); else if (state.unit) location.hash = "#/";
  }
  if (typing || event.ctrlKey || event.metaKey || at("ask").open) return;
  if (event.key === "/") { event.preventDefault(); location.hash = "#/"; at("search").focus(); }
  if (event.key === "t") turn();
  const rows = [...at("units").tBodies[0].rows];
  const place = rows.indexOf(document.activeElement);
  if (!state.unit && (event.key === "ArrowDown" || event.key === "ArrowUp")) {
    event.preventDefault();
    rows[Math.min(rows.length - 1, Math.max(0, place + (event.key === "ArrowDown" ? 1 : -1)))]?.focus();
  }
  if (!state.unit && event.key === "Enter" && place >= 0) open(rows[place].dataset.unit);
});
at("logout").addEventListener("click", async () => { await ask("/api/logout", {}); location.href = "/login"; });

paint();
state.user = await ask("/api/me");
at("logout").hidden = !state.user.login;
fromFile(state.user);
addEventListener("hashchange", route);
connect();
await route();
