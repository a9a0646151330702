"use strict";
// The table of all hemispheres and their maps: one list of rows, sorted and filtered together.
(() => {
  const { columns, rows, grid, apart } = JSON.parse(document.getElementById("data").textContent);
  const $ = (id) => document.getElementById(id);
  const make = (name, properties = {}, ...children) => {
    const element = Object.assign(document.createElement(name), properties);
    element.append(...children);
    return element;
  };
  const table = $("table"), tiles = $("tiles"), selected = new Set();
  let order = { key: null, down: false };
  let shown = rows;

  const words = (row, column) => {
    const value = row[column.key];
    if (column.digits === undefined) return value ?? "";
    if (value === null || value === undefined) return "";
    return column.percent ? `${(100 * value).toFixed(column.digits)}%` : value.toFixed(column.digits);
  };
  const whose = (row) => [row.participant, row.session, row.hemi === "L" ? "left" : "right", row.seg, row.region === "body" ? "" : row.region].filter(Boolean).join(" ");

  function fillTable() {
    const heads = columns.map((column) => {
      const unit = column.unit ? ` [${column.unit.replace("^2", "²").replace("^3", "³")}]` : "";
      const button = make("button", { type: "button", className: "sort", textContent: column.title + unit, title: column.help ?? "" });
      button.addEventListener("click", () => sortBy(column));
      const head = make("th", { scope: "col", className: column.digits === undefined ? "" : "n" }, button);
      head.dataset.key = column.key;
      return head;
    });
    const first = make("th", { scope: "col" }, make("span", { className: "hidden", textContent: "Select" }));
    table.append(make("thead", {}, make("tr", {}, first, ...heads)), make("tbody"));
    for (const row of rows) {
      const box = make("input", { type: "checkbox", ariaLabel: `select ${whose(row)}` });
      box.addEventListener("change", () => select([row], box.checked));
      const cells = columns.map((column) => {
        const cell = make("td", { className: column.digits === undefined ? "" : "n" });
        if (column.key === "participant") cell.append(make("a", { href: row.page, textContent: row.participant }));
        else if (column.key === "status") cell.append(make("span", { className: `badge ${row.status}`, textContent: row.status }));
        else if (column.key === "reason") cell.append(make("span", { className: "reason", textContent: row.reason, title: row.message }));
        else cell.textContent = words(row, column);
        if (column.key === "distance" && row.distance > apart) cell.classList.add("unusual");
        return cell;
      });
      row.box = box;
      row.line = make("tr", {}, make("td", {}, box), ...cells);
    }
  }

  function fillTiles() {
    if (!tiles) return;
    const width = 96, height = Math.round(width * grid.aspect);
    tiles.style.cssText = `--w:${width}px;--h:${height}px;--all:${grid.columns * width}px ${grid.rows * height}px`;
    for (const row of rows) {
      const tile = make("span", { className: row.tile === null ? "tile none" : "tile" });
      if (row.tile === null) tile.textContent = "no map";
      else tile.style.backgroundPosition = `${-(row.tile % grid.columns) * width}px ${-Math.floor(row.tile / grid.columns) * height}px`;
      const title = make("span", { className: "name", textContent: `${row.participant.slice(4)}${row.session ? ` ${row.session.slice(4)}` : ""} ${row.hemi}` });
      const link = make("a", { href: row.page, title: `${whose(row)}: ${row.status}`, ariaLabel: `${whose(row)}, ${row.status}` }, tile, title);
      const far = row.distance > apart ? " apart" : "";
      row.item = make("li", { className: row.status + far }, link);
    }
    for (const radio of document.querySelectorAll("[name=map]")) radio.addEventListener("change", showMaps);
    showMaps();
  }

  function showMaps() {
    const kind = document.querySelector("[name=map]:checked").value;
    tiles.className = kind;
    for (const bar of document.querySelectorAll(".colorbar")) bar.hidden = !bar.classList.contains(`map-${kind}`);
  }

  function sortBy({ key, digits }) {
    order = { key, down: order.key === key ? !order.down : digits !== undefined };
    for (const head of table.querySelectorAll("thead [data-key]")) {
      if (head.dataset.key === key) head.ariaSort = order.down ? "descending" : "ascending";
      else head.removeAttribute("aria-sort");
    }
    show();
  }

  function compare(a, b) {
    const [x, y] = [a[order.key], b[order.key]];
    // What is missing comes last, either way.
    if (x === y) return 0;
    if (x === null || x === "") return 1;
    if (y === null || y === "") return -1;
    const less = typeof x === "number" ? x - y : x.localeCompare(y, "en", { numeric: true });
    return order.down ? -less : less;
  }

  function show() {
    const text = $("search").value.trim().toLowerCase();
    const states = new Set([...document.querySelectorAll("[name=status]:checked")].map((box) => box.value));
    shown = rows.filter((row) =>
      states.has(row.status) && (!$("hemi").value || row.hemi === $("hemi").value) && (!$("seg").value || row.seg === $("seg").value)
      && (!$("apart").checked || row.distance > apart)
      && (!text || [row.participant, row.session, row.reason, row.message, row.farthest].join(" ").toLowerCase().includes(text)));
    if (order.key) shown = [...shown].sort(compare);
    table.tBodies[0].replaceChildren(...shown.map((row) => row.line));
    if (tiles) tiles.replaceChildren(...shown.map((row) => row.item));
    tell();
  }

  function select(some, on) {
    for (const row of some) {
      row.box.checked = on;
      if (on) selected.add(row);
      else selected.delete(row);
    }
    tell();
  }

  function tell() {
    $("shown").textContent = `${shown.length} of ${rows.length} shown, ${selected.size} selected`;
    $("save").disabled = !selected.size;
  }

  function exclusions() {
    const cell = (text) => String(text || "n/a").split(/\s+/).join(" ");
    const why = (row) => row.status === "ok" && row.distance > apart ? `outlier in ${row.farthest}` : row.reason || "selected by hand";
    const lines = rows.filter((row) => selected.has(row)).map((row) => [row.participant, row.session, row.hemi, row.seg, row.region, `${row.status}: ${why(row)}`].map(cell).join("\t"));
    return ["participant_id\tsession_id\themi\tprotocol\tregion\treason", ...new Set(lines)].join("\n") + "\n";
  }

  function save() {
    const link = make("a", { download: "exclude.tsv", href: URL.createObjectURL(new Blob([exclusions()], { type: "text/tab-separated-values" })) });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  for (const seg of [...new Set(rows.map((row) => row.seg))]) $("seg").append(make("option", { value: seg, textContent: seg }));
  document.querySelector(".filters").addEventListener("input", show);
  document.querySelector(".filters").addEventListener("submit", (event) => event.preventDefault());
  $("select-shown").addEventListener("click", () => select(shown, true));
  $("select-none").addEventListener("click", () => select(rows, false));
  $("save").addEventListener("click", save);
  fillTable();
  fillTiles();
  show();
})();
