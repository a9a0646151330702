// A page opened from a folder may not start a worker: that of the search runs in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      const inside = this.frame.contentWindow;
      inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      const script = inside.document.createElement("script");
      this.ready = new Promise((resolve) => script.addEventListener("load", resolve));
      script.src = url;
      inside.document.body.append(script);
    }

    async postMessage(data) {
      await this.ready;
      this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data }));
    }

    terminate() {
      this.frame.remove();
    }
  };
}

// A word of a question also finds longer words: "a" would find "age". Words without a topic are
// removed before the question is sent.
const COMMON = new Set(
  (
    "a am an and are as at be been by can could did do does for from had has have how i if in into " +
    "is it its my of on or our should so than that the their then there these they this to use " +
    "using was we were what when where which who why will with would you your"
  ).split(" "),
);

function keywords(question) {
  const words = question.split(/\s+/).filter((word) => !COMMON.has(word.toLowerCase()));
  return words.length ? words.join(" ") : question;
}

const QUERY = 2; // the type of the theme's messages with a question
const send = Worker.prototype.postMessage;
Worker.prototype.postMessage = function (message, ...rest) {
  const query = message.type === QUERY ? { ...message, data: keywords(message.data) } : message;
  return send.call(this, query, ...rest);
};
