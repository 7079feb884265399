// A page that was opened from a folder may start no worker: there the same script runs in a hidden frame.
if (location.protocol === "file:") {
  window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      this.waiting = [];
      const quoted = String(url).replace(/"/g, "%22");
      frame.contentDocument.open();
      frame.contentDocument.write(`<!doctype html><body><script>
        var importScripts = (...urls) => urls.reduce((before, url) => before.then(() => new Promise((done, failed) => {
          document.body.append(Object.assign(document.createElement("script"), { src: url, onload: done, onerror: failed }));
        })), Promise.resolve());
      <\/script><script src="${quoted}"><\/script></body>`);
      frame.contentDocument.close();
      this.frame = frame;
      this.tell = (data) => {
        const event = new MessageEvent("message", { data });
        this.dispatchEvent(event);
        if (this.onmessage) this.onmessage(event);
      };
      frame.contentWindow.postMessage = (data) => setTimeout(() => this.tell(data));
      frame.addEventListener("load", () => { this.ready = true; this.waiting.splice(0).forEach((data) => this.postMessage(data)); });
    }

    postMessage(data) {
      if (!this.ready) return void this.waiting.push(data);
      this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data }));
    }

    terminate() { this.frame.remove(); }
  };
  window.Worker = window.IFrameWorker;
}
