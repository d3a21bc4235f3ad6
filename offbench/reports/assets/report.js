"use strict";
// Sort a table by the column whose header is clicked: numbers by value (missing ones last), words by alphabet.
for (const table of document.querySelectorAll("table:not(.plain)")) {
  const body = table.tBodies[0];
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = head.querySelector("button");
    if (!button) return;
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") !== "descending" && head.classList.contains("number")
        || head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const sign = down ? -1 : 1;
      const rows = [...body.rows];
      const number = (cell) => ("value" in cell.dataset ? Number(cell.dataset.value) : NaN);
      rows.sort((a, b) => {
        const [one, two] = [a.cells[column], b.cells[column]];
        const [x, y] = [number(one), number(two)];
        if (Number.isNaN(x) && Number.isNaN(y)) return sign * one.textContent.localeCompare(two.textContent);
        if (Number.isNaN(x)) return 1;
        if (Number.isNaN(y)) return -1;
        return sign * (x - y);
      });
      body.append(...rows);
    });
  });
}
// A click on a cell opens the box that says where its number comes from.
for (const button of document.querySelectorAll("button[data-box]")) {
  button.addEventListener("click", () => document.getElementById(button.dataset.box).showModal());
}
for (const box of document.querySelectorAll("dialog")) {
  box.querySelector(".close").addEventListener("click", () => box.close());
  box.addEventListener("click", (event) => {
    if (event.target === box) box.close(); // outside its content: the backdrop
  });
}
