"use strict";
// Rates the hemispheres of a page and leads to the next one.
(() => {
  const cards = [...document.querySelectorAll(".card[data-key]")];
  if (!cards.length) return;
  const named = () => cards.find((card) => `#${card.id}` === decodeURIComponent(location.hash));
  let current = null;

  function choose(card) {
    current = card;
    for (const other of cards) other.classList.toggle("current", other === card && cards.length > 1);
  }

  // Keys are about the card whose rating is in view: that which fills most of the window.
  function follow() {
    const seen = cards.map((card) => { const { top, bottom } = card.getBoundingClientRect(); return Math.min(bottom, innerHeight) - Math.max(top, 0); });
    const most = Math.max(...seen);
    if (most > 0 && seen[cards.indexOf(current)] < most) choose(cards[seen.indexOf(most)]);
  }

  function show(card) {
    const { rating = "", note = "", input_hash = "" } = kept.read(card.dataset.key) ?? {};
    const earlier = rating && input_hash !== card.dataset.hash;
    for (const radio of card.querySelectorAll(".rating [type=radio]")) radio.checked = !earlier && radio.value === rating;
    card.querySelector(".remark").value = note;
    card.querySelector(".earlier").textContent = earlier ? `Rated “${rating}” when its labels were others: rate it again.` : "";
  }

  function keep(card, value) {
    kept.write(card.dataset.key, value.rating || value.note ? value : null);
    show(card);
    card.querySelector(".told").textContent = kept.lasting ? "Kept by this browser." : "This browser keeps nothing.";
  }

  const rate = (card, rating) => keep(card, { rating, note: card.querySelector(".remark").value.trim(), input_hash: card.dataset.hash });

  function lead() {
    // The table's order, as it was left; without it, links are those of the table.
    const kind = /^sub-[\w-]+\.html$/;  // any page on this disk may write what this one reads
    const order = kept.read("order");
    if (!Array.isArray(order) || !order.every((row) => kind.test(row?.page))) return;
    for (const card of cards) {
      const here = order.findIndex((row) => row.key === card.dataset.key);
      if (here < 0) continue;
      for (const [name, step] of [["previous", -1], ["next", 1]]) {
        const link = card.querySelector(`.${name}`), row = order[here + step];
        link.hidden = !row;
        if (!row) continue;
        link.href = `${row.page}#${encodeURIComponent(row.key)}`;
        link.querySelector("span").textContent = row.words;
      }
    }
  }

  for (const card of cards) {
    show(card);
    card.addEventListener("pointerdown", () => choose(card));
    card.addEventListener("focusin", () => choose(card));
    for (const radio of card.querySelectorAll(".rating [type=radio]")) radio.addEventListener("change", () => rate(card, radio.value));
    card.querySelector(".clear").addEventListener("click", () => rate(card, ""));
    card.querySelector(".remark").addEventListener("change", (event) => {
      // A rating of other labels stays what it is.
      const { rating = "", input_hash = card.dataset.hash } = kept.read(card.dataset.key) ?? {};
      keep(card, { rating, note: event.target.value.trim(), input_hash });
    });
    for (const copy of card.querySelectorAll(".copy")) copy.addEventListener("click", () => {
      getSelection().selectAllChildren(copy.previousElementSibling);
      copy.textContent = document.execCommand("copy") ? "Copied" : "Selected: press Ctrl+C";
    });
  }
  lead();
  choose(named() ?? cards[0]);
  addEventListener("hashchange", () => choose(named() ?? current));
  addEventListener("scroll", follow, { passive: true });
  addEventListener("storage", () => { cards.forEach(show); lead(); });
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.repeat) return;
    if (event.target.closest("select, textarea, input:not([type=radio]):not([type=checkbox])")) return;
    const radios = [...current.querySelectorAll(".rating [type=radio]")];
    if (radios[event.key - 1]) rate(current, radios[event.key - 1].value);
    else if (event.key === "0") rate(current, "");
    else if (event.key === "n" || event.key === "p") {
      const link = current.querySelector(event.key === "n" ? ".next" : ".previous");
      if (!link.hidden) link.click();
    }
  });
})();
