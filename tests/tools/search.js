// Ask the search of the built site, as a browser does: print the places found for each question.
// Arguments: folder of the site, its script beside the theme, the theme's worker, questions.
const [site, script, worker, ...questions] = Deno.args;
const read = (path) => Deno.readTextFileSync(path);
const run = (code) => (0, eval)(code);
const TYPES = { setup: 0, query: 2 };

const listeners = [];
const waiting = [];
globalThis.addEventListener = (_kind, listener) => listeners.push(listener);
globalThis.postMessage = (data) => waiting.shift()(data);
run(read(worker));

// The page's end of the worker, which the script changes.
globalThis.Worker = class {
  postMessage(data) {
    return new Promise((resolve) => {
      waiting.push(resolve);
      listeners.forEach((listener) => listener({ data }));
    });
  }
};
run(read(script).replaceAll("location.protocol", '"https:"'));

const page = new Worker();
const { config, docs } = JSON.parse(read(`${site}/search/search_index.json`));
await page.postMessage({ type: TYPES.setup, data: { config, docs, options: {} } });
const answers = {};
for (const question of questions) {
  const { data } = await page.postMessage({ type: TYPES.query, data: question });
  answers[question] = data.items.map(([best]) => best.location);
}
console.log(JSON.stringify(answers));
