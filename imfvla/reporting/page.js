"use strict";
// Sorting, videos that load when they are shown, and what two rows' configs differ in.

function sortKey(cell, numeric) {
  const text = cell.textContent.trim();
  if (!numeric) return text;
  const number = text.match(/^[<+]?(-?\d[\d.]*)/);
  return number ? Number(number[1]) : NaN; // of "84/100 [75%, 90%]" the first; "-" and "missing" have none
}

function compareKeys(one, other, direction) {
  if (Number.isNaN(one) || Number.isNaN(other)) return Number.isNaN(one) - Number.isNaN(other); // last, either way
  return direction * (typeof one === "number" ? one - other : one.localeCompare(other));
}

for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    head.querySelector("button").addEventListener("click", () => {
      const numeric = head.classList.contains("number");
      const first = numeric ? "descending" : "ascending";
      const second = numeric ? "ascending" : "descending";
      const order = head.getAttribute("aria-sort") === first ? second : first;
      heads.forEach((other) => other.setAttribute("aria-sort", other === head ? order : "none"));
      const direction = order === "ascending" ? 1 : -1;
      const rows = [...table.tBodies[0].rows].map((row) => [sortKey(row.cells[column], numeric), row]);
      rows.sort((one, other) => compareKeys(one[0], other[0], direction));
      table.tBodies[0].append(...rows.map(([, row]) => row));
    });
  });
}

for (const details of document.querySelectorAll("details.rollouts")) {
  details.addEventListener("toggle", () => {
    for (const video of details.querySelectorAll("video")) {
      if (details.open) video.preload = "metadata";
      else video.pause();
    }
  });
}

const configs = JSON.parse(document.getElementById("configs").textContent);
const choices = ["one", "other"].map((name) => document.getElementById(`differ-${name}`));

function showDifferences() {
  const [one, other] = choices.map((choice) => configs[choice.value] || {});
  const keys = [...new Set([...Object.keys(one), ...Object.keys(other)])].filter((key) => one[key] !== other[key]);
  const body = document.getElementById("differences").tBodies[0];
  body.replaceChildren(
    ...keys.map((key) => {
      const row = document.createElement("tr");
      for (const text of [key, one[key] ?? "-", other[key] ?? "-"]) row.insertCell().textContent = text;
      return row;
    }),
  );
  document.getElementById("no-difference").hidden = keys.length > 0;
}

if (choices[0]) {
  if (choices[1].options.length > 1) choices[1].selectedIndex = 1;
  choices.forEach((choice) => choice.addEventListener("change", showDifferences));
  showDifferences();
}
