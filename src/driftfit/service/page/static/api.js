const make = (tag, text, parent, kind) => {
  const one = document.createElement(tag);
  if (text) one.textContent = text;
  if (kind) one.className = kind;
  parent.append(one);
  return one;
};
const about = await (await fetch("/api/openapi.json")).json();
const home = document.getElementById("paths");
for (const [path, item] of Object.entries(about.paths)) {
  for (const [method, one] of Object.entries(item)) {
    if (method === "parameters") continue;
    const part = make("section", "", home, "operation");
    const title = make("h2", "", part);
    make("code", `${method.toUpperCase()} ${path}`, title);
    make("p", one.summary, part);
    for (const given of one.parameters ?? []) {
      const line = make("p", "", part, "quiet");
      make("code", given.name, line);
      line.append(` ${given.description ?? ""}${given.required ? " (required)" : ""}`);
    }
    if (one.requestBody) make("pre", JSON.stringify(one.requestBody.content["application/json"].schema, null, 1), part);
  }
}
