"use strict";

// A table's heading becomes a button: ascending, descending, as it was.
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0];
  const rows = [...body.rows];
  const heads = [...table.tHead.rows[0].cells];
  const text = (row, column) => row.cells[column].textContent.trim();
  const key = (row, column) => parseFloat(row.cells[column].dataset.key);
  const compare = (column, sign) => (one, other) => {
    const [a, b] = [key(one, column), key(other, column)];
    if (Number.isNaN(a) !== Number.isNaN(b)) return Number.isNaN(a) ? 1 : -1; // words at the end
    if (!Number.isNaN(a)) return sign * (a - b);
    return sign * text(one, column).localeCompare(text(other, column), "en", { numeric: true });
  };
  const next = { none: "ascending", ascending: "descending", descending: "none" };
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    // On paper a head is repeated on the next page, without the buttons in it.
    const paper = document.createElement("span");
    paper.className = "paper";
    paper.textContent = head.textContent;
    button.append(...head.childNodes);
    head.append(button, paper);
    button.addEventListener("click", () => {
      const order = next[head.getAttribute("aria-sort") || "none"];
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      if (order !== "none") head.setAttribute("aria-sort", order);
      const sign = order === "descending" ? -1 : 1;
      body.append(...(order === "none" ? rows : rows.toSorted(compare(column, sign))));
    });
  });
}

// A box is a stop of the keyboard only where there is something to scroll.
const boxes = document.querySelectorAll(".box");
const stops = () =>
  boxes.forEach((box) => {
    box.tabIndex = box.scrollWidth > box.clientWidth ? 0 : -1;
  });
addEventListener("load", stops);
addEventListener("resize", stops);

// A film can be stopped, and does not start for who asked for less motion.
for (const film of document.querySelectorAll("picture")) {
  const still = film.querySelector("source");
  const button = document.createElement("button");
  button.type = "button";
  button.className = "film";
  let stopped = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const show = () => {
    still.media = stopped ? "all" : "not all";
    button.textContent = stopped ? "Play" : "Stop";
  };
  button.addEventListener("click", () => {
    stopped = !stopped;
    show();
  });
  film.after(button);
  show();
}

// What is folded is open on paper, but for lists of links.
const folded = document.querySelectorAll("details:not(.runs details)");
addEventListener("beforeprint", () => folded.forEach((part) => part.setAttribute("open", "")));
