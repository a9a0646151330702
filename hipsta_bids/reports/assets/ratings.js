"use strict";
// Ratings and order of hemispheres, kept by the browser for this folder; pages of both kinds read them.
const kept = (() => {
  const prefix = `hipsta_bids ${location.pathname.replace(/[^/]*$/, "")} `;
  const memory = new Map();
  let storage = null;
  try {
    localStorage.setItem(prefix, "");
    localStorage.removeItem(prefix);
    storage = localStorage;
  } catch { /* A browser may forbid it; ratings then last as long as the page. */ }
  return {
    lasting: storage !== null,
    prefix,
    read(name) {
      try { return JSON.parse(storage ? storage.getItem(prefix + name) : memory.get(name) ?? null); } catch { return null; }
    },
    write(name, value) {
      const empty = value === null;
      try {
        if (!storage) empty ? memory.delete(name) : memory.set(name, JSON.stringify(value));
        else if (empty) storage.removeItem(prefix + name);
        else storage.setItem(prefix + name, JSON.stringify(value));
      } catch { /* Full: what was kept before stays. */ }
    },
  };
})();
