// Search from disk: a browser starts no worker from a file:// page, so this runs the worker's script in a hidden frame.
// It has what the theme's search calls: the constructor, postMessage and "message" events.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.waiting = [];
      const frame = document.createElement("iframe");
      frame.hidden = true;
      frame.onload = () => {
        this.scope = frame.contentWindow;
        // the frame has the page's own origin, so its global postMessage is replaced by one that answers here
        this.scope.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
        const script = this.scope.document.createElement("script");
        script.src = url;
        script.onload = () => {
          this.ready = true;
          for (const data of this.waiting.splice(0)) this.postMessage(data);
        };
        this.scope.document.body.append(script);
      };
      document.documentElement.append(frame);
    }
    postMessage(data) {
      if (this.ready) this.scope.dispatchEvent(new MessageEvent("message", { data }));
      else this.waiting.push(data);
    }
  };
}
