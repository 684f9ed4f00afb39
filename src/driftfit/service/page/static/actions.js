// What an operator can do to a unit; each asks for the reason, which is kept with name and time.
const at = (id) => document.getElementById(id);
const make = (tag, text, parent) => {
  const one = document.createElement(tag);
  if (text) one.textContent = text;
  parent.append(one);
  return one;
};
const field = (home, label, options) => {
  const box = make("label", `${label} `, home);
  return Object.assign(make("input", "", box), options);
};

export class Actions {
  constructor(done) {
    this.done = done; this.current = null;
    at("ask").querySelector("form").addEventListener("submit", (event) => {
      if (event.submitter?.value !== "do") return;
      event.preventDefault();
      this.send();
    });
  }
  show(about, user) {
    at("acts").hidden = user?.role !== "operator";
    const { state: it } = about;
    const wanted = JSON.stringify([about.unit, it.held, it.acknowledged, it.failure, it.unarmed]);
    if (this.wanted === wanted) { this.about = about; return; }
    this.wanted = wanted; this.about = about;
    const home = at("buttons");
    home.replaceChildren();
    const add = (text, action) => make("button", text, home).addEventListener("click", action);
    add(it.held ? "Resume learning" : "Hold", () => this.open("hold", it.held ? "Resume learning" : "Hold",
      it.held ? "Samples are used again." : "Samples are predicted, but the parameters stay as they are.", () => {},
      () => ({ on: !it.held })));
    add("Reset", () => this.reset());
    add("New limits", () => this.limits());
    if (it.acknowledged === false) add("Acknowledge alarm", () => this.open("acknowledge", "Acknowledge alarm", "", () => {}, () => ({})));
    if (it.failure || Object.keys(it.unarmed ?? {}).length) add("Restart", () => this.open("restart", "Restart", "The unit begins again without its past.", () => {}, () => ({})));
  }
  reset() {
    let which, p;
    this.open("reset", "Reset", "These parameters may have changed: the next samples decide.", (home) => {
      const box = make("label", "Parameter ", home);
      which = make("select", "", box);
      for (const name of ["all", ...this.about.about.names]) make("option", name, which);
      p = field(home, "Variance of the change", { type: "number", min: 0, step: "any", value: 1, required: true });
    }, () => ({ ...(which.value === "all" ? {} : { which: which.value }), p: Number(p.value) }));
  }
  limits() {
    const inputs = {};
    this.open("limits", "New limits", "A number outside its range counts as missing. An empty field means no limit.", (home) => {
      for (const [name, [low, high]] of Object.entries(this.about.state.limits)) {
        inputs[name] = [field(home, `${name}: lowest`, { type: "number", step: "any", value: low ?? "" }),
          field(home, `${name}: highest`, { type: "number", step: "any", value: high ?? "" })];
      }
    }, () => ({ limits: Object.fromEntries(Object.entries(inputs).map(([name, ends]) =>
      [name, ends.map((one) => (one.value === "" ? null : Number(one.value)))])) }));
  }
  open(what, title, text, fields, values) {
    this.current = { what, values };
    at("ask-title").textContent = `${title}: ${this.about.unit}`;
    at("ask-about").textContent = text;
    at("ask-problem").hidden = true;
    at("ask-fields").replaceChildren();
    fields(at("ask-fields"));
    at("ask").querySelector("[name=why]").value = "";
    at("ask").showModal();
  }
  async send() {
    const { what, values } = this.current;
    const why = at("ask").querySelector("[name=why]").value;
    const body = JSON.stringify({ unit: this.about.unit, do: what, why, ...values() });
    const answer = await fetch("/api/actions", { method: "POST", body, headers: { "Content-Type": "application/json" } });
    if (answer.ok) { at("ask").close(); setTimeout(this.done, 300); return; }
    at("ask-problem").textContent = (await answer.json()).error;
    at("ask-problem").hidden = false;
  }
}
