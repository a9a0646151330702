"use strict";
// The table of all hemispheres and their maps: one list of rows, sorted and filtered together.
(() => {
  const { columns, rows, grid, ratings } = JSON.parse(document.getElementById("data").textContent);
  const $ = (id) => document.getElementById(id);
  const make = (name, properties = {}, ...children) => {
    const element = Object.assign(document.createElement(name), properties);
    element.append(...children);
    return element;
  };
  const table = $("table"), tiles = $("tiles");
  let order = { key: "", down: false };  // as the rows come: those to look at first
  const collator = new Intl.Collator("en", { numeric: true });
  const FIRST = 60;
  let shown = rows, rest = 0;

  const words = (row, column) => {
    const value = row[column.key];
    if (column.digits === undefined) return value ?? "";
    if (value === null || value === undefined) return "";
    return column.percent ? `${(100 * value).toFixed(column.digits)}%` : value.toFixed(column.digits);
  };
  const several = columns.some((column) => column.key === "seg");
  const whose = (row) => [row.participant, row.session, row.hemi === "L" ? "left" : "right", several ? row.seg : "", row.region === "body" ? "" : row.region].filter(Boolean).join(" ");

  function fillTable() {
    const heads = columns.map((column) => {
      const unit = column.unit ? ` [${column.unit.replace("^2", "²").replace("^3", "³")}]` : "";
      const button = make("button", { type: "button", className: "sort", textContent: column.title + unit, title: column.help ?? "" });
      button.addEventListener("click", () => sortBy(column));
      const head = make("th", { scope: "col", className: column.digits === undefined ? "" : "n" }, button);
      head.dataset.key = column.key;
      return head;
    });
    table.append(make("thead", {}, make("tr", {}, ...heads)), make("tbody"));
    for (const row of rows) {
      // A list for each of hundreds of rows would make sorting slow: there is one, of the row in hand.
      row.rate = make("button", { type: "button", className: "rate" });
      row.rate.addEventListener("click", () => offer(row));
      row.remark = make("span", { className: "remark" });
      const cells = columns.map((column) => {
        const cell = make("td", { className: column.digits === undefined ? "" : "n" });
        if (column.key === "participant") cell.append(make("a", { href: `${row.page}#${row.key}`, textContent: row.participant }));
        else if (column.key === "decision") cell.append(make("span", { className: `badge ${row.decision}`, textContent: row.decision, title: row.because }));
        else if (column.key === "rating") cell.append(row.rate, row.remark);
        else if (column.key === "reason") cell.append(make("span", { className: "reason", textContent: row.reason, title: row.message }));
        else cell.textContent = words(row, column);
        if (column.key === "distance" && row.farthest) cell.classList.add("unusual");
        return cell;
      });
      row.line = make("tr", {}, ...cells);
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
      const title = make("span", { className: "name", textContent: `${row.participant.slice(4)}${row.session ? ` ${row.session.slice(4)}` : ""} ${row.hemi}${several ? ` ${row.seg}` : ""}` });
      const link = make("a", { href: `${row.page}#${row.key}`, title: `${whose(row)}: ${row.verdict}`, ariaLabel: `${tile.textContent}${title.textContent}: ${whose(row)}, ${row.verdict}` }, tile, title);
      const far = row.farthest ? " apart" : "";
      row.item = make("li", { className: row.decision + far }, link);
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
    markOrder();
    show();
  }

  function markOrder() {
    const { key } = order;
    for (const head of table.querySelectorAll("thead [data-key]")) {
      if (head.dataset.key === key) head.ariaSort = order.down ? "descending" : "ascending";
      else head.removeAttribute("aria-sort");
    }
  }

  function compare(a, b) {
    const [x, y] = [a[order.key], b[order.key]];
    // What is missing comes last, either way.
    if (x === y) return 0;
    if (x === null || x === "") return 1;
    if (y === null || y === "") return -1;
    const less = typeof x === "number" ? x - y : collator.compare(x, y);
    return order.down ? -less : less;
  }

  function show() {
    const text = $("search").value.trim().toLowerCase();
    const states = new Set([...document.querySelectorAll("[name=decision]:checked")].map((box) => box.value));
    shown = rows.filter((row) =>
      states.has(row.decision) && (!$("hemi").value || row.hemi === $("hemi").value) && (!$("seg").value || row.seg === $("seg").value)
      && (!$("rating").value || (row.earlier ? "earlier" : row.rating || "none") === $("rating").value)
      && (!$("apart").checked || row.farthest)
      && (!text || [row.participant, row.session, row.reason, row.message, row.farthest, row.note].join(" ").toLowerCase().includes(text)));
    if (order.key) shown = [...shown].sort(compare);
    fill();
    kept.write("order", shown.map((row) => ({ key: row.key, page: row.page, words: `${whose(row)}: ${row.verdict.toLowerCase()}` })));
    tell();
  }

  function fill() {
    // What fits a window first: to lay out hundreds of rows takes longer than to sort them.
    const parts = [[table.tBodies[0], shown.map((row) => row.line)], ...(tiles ? [[tiles, shown.map((row) => row.item)]] : [])];
    for (const [parent, items] of parts) parent.replaceChildren(...items.slice(0, FIRST));
    clearTimeout(rest);
    if (shown.length > FIRST) rest = setTimeout(() => { for (const [parent, items] of parts) parent.append(...items.slice(FIRST)); }, 50);
  }

  function tell() {
    const rated = rows.filter((row) => row.rating && !row.earlier).length;
    $("shown").textContent = `${shown.length} of ${rows.length} shown, ${rated} rated`;
    $("save").disabled = !rows.some((row) => row.rating || row.note);
  }

  function readRating(row) {
    const { rating = "", note = "", input_hash = "" } = kept.read(row.key) ?? {};
    Object.assign(row, { rating, note, rated: input_hash, earlier: Boolean(rating) && input_hash !== row.hash });
    row.rate.textContent = (!row.earlier && rating) || "none";
    row.rate.ariaLabel = `rating of ${whose(row)}: ${row.rate.textContent}`;
    row.remark.textContent = [row.earlier ? `(${rating}, of earlier labels)` : "", note].filter(Boolean).join(" ");
    row.remark.title = row.remark.textContent;
    row.remark.hidden = !row.remark.textContent;
  }

  function offer(row) {
    const choice = make("select", { ariaLabel: row.rate.ariaLabel }, ...["", ...ratings].map((value) => make("option", { value, textContent: value || "none" })));
    choice.value = row.earlier ? "" : row.rating;
    choice.addEventListener("change", () => { rate(row, choice.value); show(); });
    choice.addEventListener("blur", () => choice.replaceWith(row.rate));
    row.rate.replaceWith(choice);
    choice.focus();
  }

  function rate(row, rating, note = row.note, input_hash = row.hash) {
    kept.write(row.key, rating || note ? { rating, note, input_hash } : null);
    readRating(row);
  }

  const named = { participant_id: "participant", session_id: "session", hemi: "hemi", protocol: "seg", region: "region" };

  const cell = (text) => String(text === 0 ? text : text || "n/a").split(/\s+/).join(" ");

  function ratingsTable() {
    const lines = rows.filter((row) => row.rating || row.note).map((row) =>
      [...Object.values(named).map((key) => row[key]), row.rating, row.note, row.rated].map(cell).join("\t"));
    return [[...Object.keys(named), "rating", "note", "input_hash"].join("\t"), ...lines].join("\n") + "\n";
  }

  function shownTable() {
    const keys = [...new Set([...Object.values(named), ...columns.map((column) => column.key)])];
    const titles = Object.fromEntries(Object.entries(named).map(([title, key]) => [key, title]));
    return [keys.map((key) => titles[key] ?? key), ...shown.map((row) => keys.map((key) => cell(row[key])))].map((line) => line.join("\t")).join("\n") + "\n";
  }

  function save(name, text) {
    const link = make("a", { download: name, href: URL.createObjectURL(new Blob([text], { type: "text/tab-separated-values" })) });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  function load(text) {
    const [head, ...lines] = text.replace(/^\uFEFF/, "").split(/\r?\n/).filter(Boolean).map((line) => line.split("\t"));
    if (!head || !head.includes("participant_id") || !head.includes("rating")) return "Not loaded: the file has no columns participant_id and rating.";
    const plain = (word) => (word ?? "").replace(/^(sub|ses)-/, "");
    let loaded = 0, lost = 0;
    for (const line of lines) {
      const given = Object.fromEntries(head.map((name, n) => [name, line[n] === "n/a" ? "" : line[n] ?? ""]));
      const meant = rows.filter((row) => Object.entries(named).every(([name, key]) => !given[name] || plain(given[name]) === plain(row[key])));
      const known = !given.rating || ratings.includes(given.rating);
      if (!known || !meant.length) lost += 1;
      else for (const row of meant) { rate(row, given.rating, given.note ?? "", given.input_hash || row.hash); loaded += 1; }
    }
    return `${loaded} ratings loaded${lost ? `; ${lost} lines fit no hemisphere here, or have another rating than ${ratings.join(", ")}` : ""}.`;
  }

  function refresh() {
    rows.forEach(readRating);
    show();
  }

  for (const seg of [...new Set(rows.map((row) => row.seg))]) $("seg").append(make("option", { value: seg, textContent: seg }));
  document.querySelector(".filters").addEventListener("change", show);
  $("search").addEventListener("input", show);
  document.querySelector(".filters").addEventListener("submit", (event) => event.preventDefault());
  $("rate-shown").addEventListener("change", ({ target }) => {
    if (target.value) for (const row of shown) if (!row.rating || row.earlier) rate(row, target.value);
    target.value = "";
    show();
  });
  $("save").addEventListener("click", () => save("ratings.tsv", ratingsTable()));
  $("save-table").addEventListener("click", () => save("hemispheres.tsv", shownTable()));
  $("load").addEventListener("change", async ({ target }) => {
    $("told").textContent = load(await target.files[0].text());
    target.value = "";
    show();
  });
  if (!kept.lasting) $("told").textContent = "This browser keeps no ratings: save them before you leave.";
  // Pages of participants rate, too.
  addEventListener("storage", refresh);
  addEventListener("pageshow", (event) => { if (event.persisted) refresh(); });
  fillTable();
  fillTiles();
  markOrder();
  refresh();
})();
