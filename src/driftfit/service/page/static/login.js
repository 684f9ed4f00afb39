const form = document.getElementById("login");
form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const body = JSON.stringify(Object.fromEntries(new FormData(form)));
  const answer = await fetch("/api/login", { method: "POST", body, headers: { "Content-Type": "application/json" } });
  if (answer.ok) { location.href = "/"; return; }
  const problem = document.getElementById("problem");
  problem.textContent = (await answer.json()).error;
  problem.hidden = false;
});
