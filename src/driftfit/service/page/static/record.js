// A new unit from a table of past samples: what `driftfit identify` says of it, and the text for the configuration.
const at = (id) => document.getElementById(id);

export const fromFile = (user) => {
  const form = at("record").querySelector("form");
  at("new").hidden = user.role !== "operator";
  at("new").addEventListener("click", () => at("record").showModal());
  form.addEventListener("submit", async (event) => {
    if (event.submitter?.value !== "do") return;
    event.preventDefault();
    const [file] = form.elements.file.files;
    const query = new URLSearchParams({ y: form.elements.y.value, name: file.name.replace(/\.[^.]*$/, "") });
    event.submitter.disabled = true;
    at("record-unit").hidden = at("record-page").hidden = true;
    at("record-said").textContent = "The record is being identified.";
    const options = { method: "POST", body: file, headers: { "Content-Type": "text/csv" } };
    const answer = await fetch(`/api/identify?${query}`, options).then((one) => one.json(), () => ({ error: "The service does not answer." }));
    event.submitter.disabled = false;
    at("record-said").textContent = answer.error ?? answer.headline;
    if (answer.error) return;
    at("record-unit").textContent = `# for the configuration; match is the topic of its samples\n${answer.unit}`;
    at("record-page").href = URL.createObjectURL(new Blob([answer.page], { type: "text/html" }));
    at("record-unit").hidden = at("record-page").hidden = false;
  });
};
