// Drawings of one unit: parameters with 95 % bands, output against prediction, innovations. The columns are those of the
// server: time, y, y_hat, e, e_std, theta_1 .. theta_n, std_1 .. std_n.
const FIXED = 5, MOST = 1500, Z = 1.96;
const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const round = (v) => (v === null || v === undefined ? "–" : Number(v.toPrecision(5)).toString());

export class Charts {
  constructor(home) {
    this.home = home; this.plots = []; this.columns = null; this.names = [];
    new ResizeObserver(() => this.plots.forEach(({ plot, part }) => plot.setSize(this.size(part)))).observe(home);
  }
  clear() {
    this.plots.forEach(({ plot }) => plot.destroy());
    this.home.replaceChildren(); this.plots = []; this.columns = null;
  }
  repaint() {
    if (!this.plots.length) return;
    const columns = this.last;
    this.plots.forEach(({ plot }) => plot.destroy());
    this.home.replaceChildren(); this.plots = [];
    this.draw(columns);
  }
  size(part) { return { width: Math.max(200, part.clientWidth - 18), height: 210 }; }

  // New rows of the stream, appended to what is shown.
  live(columns, about) {
    this.names = about.about.names; this.y = about.about.y;
    if (!this.columns || this.columns.length !== columns.length) this.columns = columns;
    else {
      const end = this.columns[0].at(-1);
      const from = columns[0].findIndex((t) => t > end);
      if (from < 0) return;
      this.columns = this.columns.map((old, k) => [...old, ...columns[k].slice(from)].slice(-MOST));
    }
    const c = this.columns, n = this.names.length;
    this.draw({ x: c[0], y: c[1], y_hat: c[2], e: c[3], e_std: c[4], ends: null,
      theta: c.slice(FIXED, FIXED + n), std: c.slice(FIXED + n) });
  }
  // A range of the past, reduced by the server.
  past(found, about) {
    this.names = about.about.names; this.y = about.about.y;
    const n = this.names.length;
    const column = (kind, k) => found[kind][k] ?? [];
    const many = (kind, from, to) => Array.from({ length: to - from }, (_, k) => column(kind, from + k));
    this.draw({ x: column("mean", 0), y: column("mean", 1), y_hat: column("mean", 2), e: column("mean", 3),
      e_std: column("mean", 4), ends: { y: [column("low", 1), column("high", 1)], e: [column("low", 3), column("high", 3)] },
      theta: many("mean", FIXED, FIXED + n), std: many("mean", FIXED + n, FIXED + 2 * n) });
  }
  draw(c) {
    this.last = c;
    if (!c.x.length) return;
    const plus = (a, s, z) => a.map((v, k) => (v === null || s[k] === null || s[k] === undefined ? null : v + z * s[k]));
    const parts = this.names.map((name, k) => ({
      title: `${name}, with 95 % band`, key: name, line: name,
      data: [c.x, plus(c.theta[k], c.std[k] ?? [], -Z), plus(c.theta[k], c.std[k] ?? [], Z), c.theta[k]] }));
    const output = { title: `${this.y} and its prediction`, key: "*y", line: "predicted", second: this.y, full: true,
      data: [c.x, c.ends ? c.ends.y[0] : c.y.map(() => null), c.ends ? c.ends.y[1] : c.y.map(() => null), c.y_hat, c.y] };
    const band = c.e_std.map((s) => (s === null ? null : Z * s));
    const innovation = { title: "Innovation (output minus prediction), with 95 % band", key: "*e", line: "", second: "innovation",
      full: true, data: [c.x, band.map((v) => (v === null ? null : -v)), band, c.e] };
    [output, ...parts, innovation].forEach((one, k) => {
      if (this.plots[k]) this.plots[k].plot.setData(one.data); else this.plots.push(this.make(one));
    });
  }
  make(one) {
    const part = document.createElement("div");
    part.className = one.full ? "chart full" : "chart";
    const title = document.createElement("h3");
    title.textContent = one.title;
    part.append(title);
    this.home.append(part);
    const main = color("--main"), second = color("--second"), quiet = color("--quiet"), line = color("--line");
    const axis = { stroke: quiet, grid: { stroke: line, width: 1 }, ticks: { stroke: line, width: 1 }, font: "12px system-ui" };
    const hidden = { stroke: "transparent", width: 0, points: { show: false } };
    const value = (_, v) => round(v);
    const dates = one.data[0][0] > 1e8;
    const when = (_, v) => (v === null ? "–" : dates ? new Date(v * 1000).toLocaleString() : round(v));
    const series = [{ label: dates ? "time" : "sample", value: when },
      { ...hidden, label: "low", value }, { ...hidden, label: "high", value }];
    if (one.line) series.push({ label: one.line, stroke: main, width: 1.8, points: { show: false }, value });
    if (one.second) series.push({ label: one.second, stroke: second, width: one.line ? 1 : 1.2, points: { show: false }, value });
    const plot = new uPlot({
      ...this.size(part), series, bands: [{ series: [2, 1], fill: color("--band") }], scales: { x: { time: dates } },
      axes: [{ ...axis, space: 90 }, { ...axis, size: 62 }], cursor: { sync: { key: "unit" }, drag: { x: true, y: false } },
      legend: { live: true },
    }, one.data, part);
    return { plot, part };
  }
}
